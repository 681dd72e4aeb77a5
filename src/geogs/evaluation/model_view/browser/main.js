// Puts the model together: the surface first, so that there is something to see at once.

const box = document.getElementById('model');
const part = (name) => box.closest('.viewer').querySelector(`[data-part=${name}]`);
const HINT = matchMedia('(pointer: coarse)').matches
  ? 'one finger turns · two move and zoom'
  : 'drag to turn · wheel to zoom · right button to move';

async function show() {
  const begin = performance.now();
  const scene = JSON.parse(document.getElementById('model-scene').textContent);
  const content = await inflated(embedded('model-arrays'));
  const stage = makeStage(box, scene);
  part('hint').textContent = HINT;
  const surface = showThings(stage, scene, content, await sheetOf(scene.surface));
  const bar = part('layers');
  for (const packed of scene.paths) {
    const path = makePath(stage, packed, content);
    if (!path) continue;
    stage.world.add(path);
    toggle(bar, packed.name, true, (on) => {
      path.visible = on;
      stage.draw();
    });
  }
  if (surface) toggle(part('tools'), 'Measure', false, makeMeasure(stage, surface, scene.lengths));
  part('player').hidden = !scene.keyframes.length;
  stage.resize();
  stage.steps.add(() => {
    box.dataset.state = 'drawn';
    box.dataset.milliseconds = Math.round(performance.now() - begin);
    return false;
  });
  stage.draw();
  // Keyframes come after the first picture.
  if (scene.keyframes.length) setTimeout(() => showKeyframes(stage, scene, bar), 30);
  else part('home').addEventListener('click', stage.home);
  part('full').onclick = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else box.closest('.viewer').requestFullscreen();
  };
  // For those who look closer by the browser's console, and for tests.
  box.stage = stage;
}

// The surface in one of its looks, or the disks in its place; the surface, if there is one.
function showThings(stage, scene, content, sheet) {
  const room = makeRoom(scene.room, stage.camera);
  const surface = scene.surface && makeSurface(scene.surface, content, room, sheet);
  if (surface) stage.world.add(surface.group);
  let disks = null;
  const look = (name) => {
    const isDisks = name === 'Disks';
    if (isDisks && !disks) {
      disks = makeDisks(scene.disks, content, room);
      stage.world.add(disks);
    }
    if (disks) disks.visible = isDisks;
    if (surface) surface.group.visible = !isDisks;
    showLegend(part('legend'), isDisks ? null : surface.look(name).legend);
    stage.draw();
  };
  const names = [...(surface ? surface.looks.keys() : []), ...(scene.disks ? ['Disks'] : [])];
  if (names.length) segmented(part('looks'), names, names[0], look);
  return surface;
}

function showKeyframes(stage, scene, bar) {
  const keyframes = unpackedKeyframes(scene, embedded('model-images'));
  const frusta = makeFrusta(stage, scene.lens, keyframes);
  toggle(bar, 'Cameras', true, (on) => {
    frusta.group.visible = on;
    stage.draw();
  });
  makePlayer(stage, scene.lens, keyframes, frusta);
}

show().catch((error) => {
  box.dataset.state = 'failed';
  part('failure').hidden = false;
  console.error(error);
});
