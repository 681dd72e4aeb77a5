// Puts the model together: the surface first, so that there is something to see at once.

const box = document.getElementById('model');
const part = (name) => box.parentElement.querySelector(`[data-part=${name}]`);

async function show() {
  const begin = performance.now();
  const scene = JSON.parse(document.getElementById('model-scene').textContent);
  const content = await inflated(embedded('model-arrays'));
  const stage = makeStage(box, scene);
  const bar = part('layers'), looks = part('looks');

  if (scene.surface) {
    const surface = makeSurface(scene.surface, content);
    stage.world.add(surface.mesh);
    segmented(looks, [...surface.looks.keys()], surface.looks.keys().next().value, (name) => {
      showLegend(part('legend'), surface.look(name).legend);
      stage.draw();
    });
    toggle(bar, 'Mesh', true, (on) => {
      surface.mesh.visible = on;
      stage.draw();
    });
  }
  if (scene.disks) {
    let disks = null;
    toggle(bar, 'Disks', !scene.surface, (on) => {
      if (on && !disks) {
        disks = makeDisks(scene.disks, content);
        stage.world.add(disks);
      }
      if (disks) disks.visible = on;
      stage.draw();
    });
  }
  for (const packed of scene.paths) {
    const path = makePath(stage, packed, content);
    if (!path) continue;
    stage.world.add(path);
    toggle(bar, packed.name, true, (on) => {
      path.visible = on;
      stage.draw();
    });
  }
  stage.resize();
  stage.draw();
  stage.steps.add(() => {
    box.dataset.state = 'drawn';
    box.dataset.milliseconds = Math.round(performance.now() - begin);
    return false;
  });
  // Keyframes come after the first picture.
  if (scene.keyframes.length) setTimeout(() => showKeyframes(stage, scene, bar), 30);
  part('home').addEventListener('click', stage.home);
  part('full').onclick = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else box.parentElement.requestFullscreen();
  };
  // For those who look closer by the browser's console, and for tests.
  box.stage = stage;
}

function showKeyframes(stage, scene, bar) {
  const cameras = makeKeyframes(stage, scene, embedded('model-images'));
  stage.world.add(cameras.group, cameras.shown);
  let isOn = true, chosen = null, isInside = false;
  // Who looks from a camera is not to see its frame.
  const arrange = (inside) => {
    isInside = inside;
    cameras.group.visible = isOn && !inside;
    cameras.shown.visible = !inside;
    stage.draw();
  };
  toggle(bar, 'Keyframes', true, (on) => {
    isOn = on;
    arrange(isInside);
  });
  if (cameras.keyframes.some((k) => k.blob)) {
    toggle(bar, 'Images', false, (on) => {
      cameras.showImages(on);
      stage.draw();
    });
  }
  const inform = part('keyframe');
  const pick = (keyframe) => {
    const goes = keyframe && keyframe === chosen && !isInside;
    chosen = keyframe;
    cameras.choose(keyframe);
    mark(keyframe);
    inform.hidden = !keyframe;
    if (keyframe) inform.textContent = keyframe.name;
    arrange(Boolean(goes));
    if (goes) cameras.lookFrom(keyframe);
  };
  const mark = makeStrip(part('strip'), cameras.keyframes, pick);

  const canvas = stage.renderer.domElement;
  let down = null;
  canvas.addEventListener('pointerdown', (event) => { down = [event.clientX, event.clientY]; });
  canvas.addEventListener('pointerup', (event) => {
    if (!down || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 4) return;
    const { left, top } = canvas.getBoundingClientRect();
    const at = [event.clientX - left, event.clientY - top];
    pick(cameras.group.visible ? cameras.near(...at) : null);
  });
  stage.orbit.addEventListener('start', () => arrange(false));
  part('home').addEventListener('click', () => arrange(false));

  const fly = element('button', { type: 'button', title: 'Fly through the keyframes' }, 'Fly');
  fly.onclick = () => {
    box.classList.add('touched');
    pick(null);
    arrange(true);
    cameras.flyThrough(() => arrange(false));
  };
  if (cameras.keyframes.length > 1) bar.append(fly);
}

show().catch((error) => {
  box.dataset.state = 'failed';
  part('failure').hidden = false;
  console.error(error);
});
