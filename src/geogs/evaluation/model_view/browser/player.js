// The slider along the path: it moves a camera in the model and shows beside it what that saw.

const SECONDS_A_KEYFRAME = 0.25, LEAST_SECONDS = 6, MOST_SECONDS = 60;

function makePlayer(stage, lens, keyframes, frusta) {
  const last = keyframes.length - 1, moving = makeMoving(stage, lens, keyframes);
  const shown = new THREE.Group();
  shown.add(frusta.group, moving.group);
  stage.world.add(shown);
  const slider = part('place'), play = part('play'), ride = part('ride');
  const picture = part('beside').querySelector('img');
  const isOn = (button) => button.getAttribute('aria-pressed') === 'true';
  const press = (button, on) => button.setAttribute('aria-pressed', String(on));
  const addresses = new Map();
  const showImage = (keyframe) => {
    if (!addresses.has(keyframe)) addresses.set(keyframe, URL.createObjectURL(keyframe.blob));
    picture.src = addresses.get(keyframe);
    part('beside').hidden = false;
  };

  const go = (place) => {
    slider.value = place;
    const keyframe = moving.moveTo(place);
    if (keyframe.blob) showImage(keyframe);
    part('keyframe').textContent = keyframe.name;
    if (isOn(ride)) moving.ride();
  };
  const stop = () => {
    press(play, false);
    stage.steps.clear();
  };
  const start = () => {
    press(play, true);
    const seconds = Math.min(Math.max(SECONDS_A_KEYFRAME * last, LEAST_SECONDS), MOST_SECONDS);
    const from = Number(slider.value) < last ? Number(slider.value) : 0, begin = performance.now();
    stage.run((now) => {
      const place = Math.min(from + Math.max(now - begin, 0) / 1000 / seconds * last, last);
      go(place);
      if (place === last) stop();
      return place < last;
    });
  };
  // Who looks through the camera sees no frames of cameras.
  const setRide = (on) => {
    press(ride, on);
    shown.visible = !on;
  };

  // A picture held upright is no taller than one held across.
  part('beside').style.maxWidth = `${Math.min(300, 220 * lens.right / lens.down)}px`;
  slider.max = last;
  slider.oninput = () => {
    stop();
    go(Number(slider.value));
  };
  play.onclick = () => (isOn(play) ? stop() : start());
  ride.onclick = () => {
    const plays = isOn(play);
    stop();
    setRide(!isOn(ride));
    stage.box.classList.add('touched');
    if (!isOn(ride)) stage.home();
    else if (plays) start();
    else go(Number(slider.value));
  };
  // Who takes hold of the model leaves the camera where it is, and goes on from there.
  stage.orbit.addEventListener('start', () => {
    press(play, false);
    setRide(false);
  });
  part('home').addEventListener('click', () => {
    stop();
    setRide(false);
    stage.home();
  });
  stage.clicks.push((x, y) => {
    const number = frusta.group.visible ? frusta.near(x, y) : null;
    if (number !== null) go(number);
    return number !== null;
  });
  go(0);
}
