// Renderer, camera and the way they are turned; draws only when something has changed.

const DEGREES_A_PIXEL = 0.24;  // a drag of 250 pixels turns by 60 degrees, whatever the height

function makeStage(box, scene) {
  const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  box.prepend(renderer.domElement);
  const world = new THREE.Scene();
  const { field, aspect } = scene.start;
  const hasImages = scene.keyframes.some(({ image }) => image);
  const beside = hasImages ? Math.min(300, 220 * scene.lens.right / scene.lens.down) : 0;
  const eye = new THREE.Vector3(...scene.start.eye), target = new THREE.Vector3(...scene.start.target);
  const reach = eye.distanceTo(target) || 1;
  const camera = new THREE.PerspectiveCamera(field, 1, reach / 500, reach * 50);
  const orbit = new THREE.OrbitControls(camera, renderer.domElement);
  orbit.enableDamping = false;
  orbit.zoomToCursor = true;
  orbit.zoomSpeed = 1.5;
  orbit.maxDistance = reach * 10;

  const stage = { renderer, world, camera, orbit, reach, box, steps: new Set(), drawn: new Set() };
  let waiting = false;
  stage.draw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame((now) => {
      waiting = false;
      orbit.update();
      for (const step of [...stage.steps]) if (step(now) === false) stage.steps.delete(step);
      renderer.render(world, camera);
      for (const act of stage.drawn) act();
      if (stage.steps.size) stage.draw();
    });
  };
  orbit.addEventListener('change', stage.draw);
  orbit.addEventListener('start', () => {
    stage.steps.clear();
    box.classList.add('touched');
  });

  // The first view holds all in a picture of some width; a narrower one is seen from farther.
  const first = () => target.clone().addScaledVector(
    eye.clone().sub(target), Math.max(1, aspect / camera.aspect));
  stage.resize = () => {
    const { clientWidth: width, clientHeight: height } = box;
    if (!width || !height) return;
    renderer.setSize(width, height);
    // The images of the keyframes have the right of the picture, the model the rest.
    const free = width - (width > 700 ? Math.min(0.23 * width, beside) : 0);
    camera.aspect = free / height;
    camera.setViewOffset(free, height, 0, 0, width, height);
    orbit.rotateSpeed = DEGREES_A_PIXEL * height / 360;
    if (!box.classList.contains('touched')) {
      camera.position.copy(first());
      orbit.target.copy(target);
      orbit.update();
    }
    box.dispatchEvent(new CustomEvent('resized'));
    stage.draw();
  };
  new ResizeObserver(stage.resize).observe(box);

  // Move the camera to a place in a while; what the user does meanwhile ends it.
  stage.fly = (to, lookAt, milliseconds = 700) => {
    const from = camera.position.clone(), before = orbit.target.clone(), start = performance.now();
    const wide = camera.fov;
    stage.run((now) => {
      const t = Math.min(Math.max((now - start) / milliseconds, 0), 1), s = t * t * (3 - 2 * t);
      camera.position.lerpVectors(from, to, s);
      orbit.target.lerpVectors(before, lookAt, s);
      camera.fov = wide + (field - wide) * s;
      camera.updateProjectionMatrix();
      camera.lookAt(orbit.target);
      return t < 1;
    });
  };
  stage.home = () => stage.fly(first(), target);
  stage.run = (step) => {
    stage.steps.clear();
    stage.steps.add(step);
    stage.draw();
  };

  addPointing(stage);
  return stage;
}

// What is where: pixels of points, rays of pixels, and what is done at clicks.
function addPointing(stage) {
  const { box, camera } = stage;
  // Where a point is in the box, in pixels; none behind the camera.
  stage.pixel = (point) => {
    const { x, y, z } = point.clone().project(camera);
    return z < 1 ? [(x + 1) / 2 * box.clientWidth, (1 - y) / 2 * box.clientHeight] : null;
  };
  const caster = new THREE.Raycaster();
  stage.ray = (x, y) => {
    const place = [x / box.clientWidth * 2 - 1, 1 - y / box.clientHeight * 2];
    caster.setFromCamera(new THREE.Vector2(...place), camera);
    return caster;
  };
  // What is done at a click, which is no drag: the first of these that takes it.
  stage.clicks = [];
  const canvas = stage.renderer.domElement;
  let down = null;
  canvas.addEventListener('pointerdown', (event) => { down = [event.clientX, event.clientY]; });
  canvas.addEventListener('pointerup', ({ clientX, clientY }) => {
    if (!down || Math.hypot(clientX - down[0], clientY - down[1]) > 5) return;
    const { left, top } = canvas.getBoundingClientRect();
    stage.clicks.some((act) => act(clientX - left, clientY - top));
  });
}
