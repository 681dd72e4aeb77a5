// Paths, keyframes as frusta, and their images.

const PATH = { tracked: 0xf2a33a, turned: 0xb58cff, lost: 0xff5a5a, truth: 0xc9ced6 };
const FRUSTUM = 0x6fb1f0, CHOSEN = 0xffd166;

function lines(stage, points, width, colours) {
  const geometry = new THREE.LineSegmentsGeometry();
  geometry.setPositions(points);
  if (Array.isArray(colours)) geometry.setColors(colours);
  const material = new THREE.LineMaterial({
    linewidth: width, vertexColors: Array.isArray(colours),
    color: Array.isArray(colours) ? 0xffffff : colours,
  });
  const resized = () => material.resolution.set(stage.box.clientWidth, stage.box.clientHeight);
  resized();
  stage.box.addEventListener('resized', resized);
  return new THREE.LineSegments2(geometry, material);
}

function makePath(stage, { name, points, states }, content) {
  const at = floats(unpacked(content, points));
  const known = states && unpacked(content, states);
  const ends = [], colours = [];
  for (let i = 0; i + 5 < at.length; i += 3) {
    ends.push(...at.slice(i, i + 6));
    for (const j of [i / 3, i / 3 + 1]) {
      const kind = known ? [PATH.tracked, PATH.turned, PATH.lost][known[j]] : PATH.truth;
      const { r, g, b } = new THREE.Color(kind);
      colours.push(r, g, b);
    }
  }
  if (!ends.length) return null;
  const line = lines(stage, ends, known ? 3 : 2, colours);
  line.name = name;
  return line;
}

function makeKeyframes(stage, scene, images) {
  const { right, down } = scene.lens;
  const depth = 0.035 * stage.reach / Math.max(right, down);
  const group = new THREE.Group(), shown = new THREE.Group();
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]];
  const keyframes = scene.keyframes.map(({ name, T_wc: m, image }, number) => {
    const T = new THREE.Matrix4().set(...m, 0, 0, 0, 1);
    const blob = image && new Blob([images.subarray(image[0], image[0] + image[1])],
      { type: 'image/jpeg' });
    const position = new THREE.Vector3(m[3], m[7], m[11]);
    const forward = new THREE.Vector3(m[2], m[6], m[10]);
    return { name, number, T, blob, position, forward };
  });

  const ends = (keyframe, size) => {
    const at = (x, y, z) => new THREE.Vector3(x, y, z).applyMatrix4(keyframe.T);
    const far = corners.map(([x, y]) => at(x * right * size, y * down * size, size));
    const apex = at(0, 0, 0), result = [];
    far.forEach((corner, i) => {
      const next = far[(i + 1) % 4];
      result.push(...apex.toArray(), ...corner.toArray(), ...corner.toArray(), ...next.toArray());
    });
    return result;
  };
  // Of keyframes that stand close together and look the same way, one is drawn.
  const drawn = [];
  for (const keyframe of keyframes) {
    const { position, forward } = keyframe;
    const isNear = (other) => other.position.distanceTo(position) < 0.4 * depth
      && other.forward.dot(forward) > 0.94;
    if (!drawn.slice(-60).some(isNear)) drawn.push(keyframe);
  }
  const all = drawn.flatMap((keyframe) => ends(keyframe, depth));
  if (all.length) group.add(lines(stage, all, 1.5, FRUSTUM));

  const loaded = new Map();
  const picture = (keyframe, size) => {
    const plane = new THREE.Mesh(
      new THREE.PlaneGeometry(2 * right, 2 * down),
      new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, color: 0x30343b }));
    // The plane's y points up in the image, the camera's down.
    plane.matrixAutoUpdate = false;
    plane.matrix.copy(keyframe.T)
      .multiply(new THREE.Matrix4().makeScale(size, -size, -size))
      .multiply(new THREE.Matrix4().makeTranslation(0, 0, -1));
    plane.userData.keyframe = keyframe;
    if (!loaded.has(keyframe)) {
      loaded.set(keyframe, createImageBitmap(keyframe.blob, { imageOrientation: 'flipY' })
        .then((bitmap) => {
          const texture = new THREE.Texture(bitmap);
          texture.flipY = false;
          texture.colorSpace = THREE.SRGBColorSpace;
          texture.needsUpdate = true;
          return texture;
        }));
    }
    loaded.get(keyframe).then((texture) => {
      plane.material.map = texture;
      plane.material.color.set(0xffffff);
      plane.material.needsUpdate = true;
      stage.draw();
    });
    return plane;
  };

  let planes = null, chosen = null;
  const showImages = (on) => {
    if (on && !planes) {
      planes = new THREE.Group();
      drawn.filter((k) => k.blob).forEach((k) => planes.add(picture(k, depth)));
      group.add(planes);
    }
    if (planes) planes.visible = on;
  };
  const choose = (keyframe) => {
    if (chosen) shown.remove(...chosen.parts);
    chosen = keyframe && { keyframe, parts: [lines(stage, ends(keyframe, 2 * depth), 2.5, CHOSEN)] };
    if (keyframe && keyframe.blob) chosen.parts.push(picture(keyframe, 2 * depth));
    if (chosen) shown.add(...chosen.parts);
    stage.draw();
  };

  // The nearest apex or image centre within some pixels of the pointer.
  const near = (x, y) => {
    let best = null, least = 22;
    for (const keyframe of keyframes) {
      for (const z of [0, depth]) {
        const at = new THREE.Vector3(0, 0, z).applyMatrix4(keyframe.T).project(stage.camera);
        if (at.z > 1) continue;
        const dx = (at.x + 1) / 2 * stage.box.clientWidth - x;
        const dy = (1 - at.y) / 2 * stage.box.clientHeight - y;
        const away = Math.hypot(dx, dy);
        if (away < least) [best, least] = [keyframe, away];
      }
    }
    return best;
  };

  const ahead = 0.15 * stage.reach;
  const field = () => 2 * Math.atan(Math.max(down, right / stage.camera.aspect)) * 180 / Math.PI;
  const lookFrom = ({ position, forward }) =>
    stage.fly(position, position.clone().addScaledVector(forward, ahead), field());

  // From the first keyframe to the last, at a quarter of a second each.
  const flyThrough = (ended) => {
    const count = keyframes.length, { camera, orbit } = stage;
    const seconds = Math.min(Math.max(0.25 * count, 4), 40);
    const start = performance.now();
    camera.fov = field();
    camera.updateProjectionMatrix();
    stage.run((now) => {
      const place = Math.min(Math.max((now - start) / 1000 / seconds, 0), 1) * (count - 1);
      const a = keyframes[Math.floor(place)], b = keyframes[Math.min(Math.floor(place) + 1, count - 1)];
      const way = new THREE.Vector3().lerpVectors(a.forward, b.forward, place % 1);
      camera.position.lerpVectors(a.position, b.position, place % 1);
      orbit.target.copy(camera.position).addScaledVector(way, ahead);
      camera.lookAt(orbit.target);
      if (place < count - 1) return true;
      ended();
      return false;
    });
  };
  return { group, shown, keyframes, showImages, choose, near, lookFrom, flyThrough };
}
