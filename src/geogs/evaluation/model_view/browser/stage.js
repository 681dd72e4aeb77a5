// Renderer, camera and the way they are turned; draws only when something has changed.

function makeStage(box, scene) {
  const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  box.prepend(renderer.domElement);
  const world = new THREE.Scene();
  const eye = new THREE.Vector3(...scene.eye), target = new THREE.Vector3(...scene.target);
  const reach = eye.distanceTo(target) || 1;
  const camera = new THREE.PerspectiveCamera(45, 1, reach / 500, reach * 50);
  camera.position.copy(eye);
  const orbit = new THREE.OrbitControls(camera, renderer.domElement);
  orbit.target.copy(target);
  orbit.enableDamping = true;
  orbit.dampingFactor = 0.12;
  orbit.zoomToCursor = true;
  orbit.update();

  const stage = { renderer, world, camera, orbit, reach, box, steps: new Set() };
  let waiting = false;
  stage.draw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame((now) => {
      waiting = false;
      orbit.update();
      for (const step of [...stage.steps]) if (step(now) === false) stage.steps.delete(step);
      renderer.render(world, camera);
      if (stage.steps.size) stage.draw();
    });
  };
  orbit.addEventListener('change', stage.draw);
  orbit.addEventListener('start', () => {
    stage.steps.clear();
    box.classList.add('touched');
  });

  const resize = () => {
    const { clientWidth: width, clientHeight: height } = box;
    if (!width || !height) return;
    renderer.setSize(width, height);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    box.dispatchEvent(new CustomEvent('resized', { detail: { width, height } }));
    stage.draw();
  };
  stage.resize = resize;
  new ResizeObserver(resize).observe(box);

  // Move the camera to a place in a while; what the user does meanwhile ends it.
  stage.fly = (to, lookAt, field = 45, milliseconds = 900) => {
    const from = camera.position.clone(), before = orbit.target.clone(), start = performance.now();
    const wide = camera.fov;
    stage.run((now) => {
      const t = Math.min((now - start) / milliseconds, 1), s = t * t * (3 - 2 * t);
      camera.position.lerpVectors(from, to, s);
      orbit.target.lerpVectors(before, lookAt, s);
      camera.fov = wide + (field - wide) * s;
      camera.updateProjectionMatrix();
      camera.lookAt(orbit.target);
      return t < 1;
    });
  };
  stage.home = () => stage.fly(eye, target);
  stage.run = (step) => {
    stage.steps.clear();
    stage.steps.add(step);
    stage.draw();
  };
  return stage;
}
