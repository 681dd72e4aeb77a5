// Paths, and some keyframes as frusta.

const PATH = { tracked: 0xf2a33a, turned: 0xb58cff, lost: 0xff5a5a, truth: 0xc9ced6 };
const FRUSTUM = 0x8fb8dd;
const MOST_FRUSTA = 24, FRUSTUM_SIZE = 0.014;  // of the distance from which all is seen

function lines(stage, points, colours, options) {
  const geometry = new THREE.LineSegmentsGeometry();
  geometry.setPositions(points);
  const isMany = Array.isArray(colours);
  if (isMany) geometry.setColors(colours);
  const material = new THREE.LineMaterial({
    vertexColors: isMany, color: isMany ? 0xffffff : colours, ...options,
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
  const line = lines(stage, ends, colours, { linewidth: known ? 2.5 : 1.5 });
  line.name = name;
  return line;
}

// The corners of a frustum's lines for a camera at the origin, with the image at this depth.
function frustumLines({ right, down }, depth) {
  const far = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    .map(([x, y]) => [x * right * depth, y * down * depth, depth]);
  return far.flatMap((corner, i) => [0, 0, 0, ...corner, ...corner, ...far[(i + 1) % 4]]);
}

// Keyframes evenly spread over a path, none nearer to the one before than a distance.
function spread(keyframes, most, least) {
  const chosen = [];
  const step = Math.max(1, keyframes.length / most);
  for (let i = 0; i < keyframes.length; i += step) {
    const keyframe = keyframes[Math.floor(i)], before = chosen.at(-1);
    if (!before || before.position.distanceTo(keyframe.position) > least) chosen.push(keyframe);
  }
  return chosen;
}

function unpackedKeyframes(scene, images) {
  return scene.keyframes.map(({ name, T_wc: m, image }) => {
    const T = new THREE.Matrix4().set(...m, 0, 0, 0, 1);
    const blob = image && new Blob([images.subarray(image[0], image[0] + image[1])],
      { type: 'image/jpeg' });
    const turn = new THREE.Quaternion().setFromRotationMatrix(T);
    return { name, T, turn, blob, position: new THREE.Vector3(m[3], m[7], m[11]) };
  });
}

function makeFrusta(stage, lens, keyframes) {
  const depth = FRUSTUM_SIZE * stage.reach / Math.max(lens.right, lens.down);
  const group = new THREE.Group();
  const shape = frustumLines(lens, depth), corner = new THREE.Vector3();
  const all = spread(keyframes, MOST_FRUSTA, depth).flatMap(({ T }) => {
    const placed = [];
    for (let i = 0; i < shape.length; i += 3) {
      placed.push(...corner.fromArray(shape, i).applyMatrix4(T).toArray());
    }
    return placed;
  });
  if (all.length) {
    group.add(lines(stage, all, FRUSTUM, { linewidth: 1, transparent: true, opacity: 0.6 }));
  }
  // The number of the keyframe that is within some pixels of the pointer.
  const near = (x, y) => {
    let best = null, least = 18;
    keyframes.forEach(({ T }, number) => {
      for (const z of [0, depth]) {
        const at = stage.pixel(corner.set(0, 0, z).applyMatrix4(T));
        const away = at ? Math.hypot(at[0] - x, at[1] - y) : Infinity;
        if (away < least) [best, least] = [number, away];
      }
    });
    return best;
  };
  return { group, near };
}
