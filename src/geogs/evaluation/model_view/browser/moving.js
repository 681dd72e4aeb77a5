// The camera that the slider moves along the path: a frustum with the image in it.

const CHOSEN = 0xffd166;

async function textureOf(blob) {
  const texture = new THREE.Texture(await createImageBitmap(blob, { imageOrientation: 'flipY' }));
  texture.flipY = false;
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.needsUpdate = true;
  return texture;
}

// An image at depth 1 of a camera, and how to show that of a keyframe in it.
function makePicture(stage, { right, down }) {
  const plane = new THREE.Mesh(
    new THREE.PlaneGeometry(2 * right, 2 * down),
    new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, color: 0x30343b }));
  // The plane's y points up in the image, the camera's down.
  plane.scale.y = -1;
  plane.position.z = 1;
  const textures = new Map();
  let asked = null;
  const show = async (keyframe) => {
    asked = keyframe;
    if (!textures.has(keyframe)) textures.set(keyframe, textureOf(keyframe.blob));
    const texture = await textures.get(keyframe);
    if (asked !== keyframe) return;
    plane.material.needsUpdate = !plane.material.map;
    plane.material.map = texture;
    plane.material.color.set(0xffffff);
    stage.draw();
  };
  return { plane, show };
}

function makeMoving(stage, lens, keyframes) {
  const group = new THREE.Group(), picture = makePicture(stage, lens);
  group.add(lines(stage, frustumLines(lens, 1), CHOSEN, { linewidth: 2 }), picture.plane);
  group.scale.setScalar(2.5 * FRUSTUM_SIZE * stage.reach / Math.max(lens.right, lens.down));

  // Put it at a place, a number between two keyframes; returns that which is nearest.
  const moveTo = (place) => {
    const a = keyframes[Math.floor(place)];
    const b = keyframes[Math.min(Math.floor(place) + 1, keyframes.length - 1)];
    group.position.lerpVectors(a.position, b.position, place % 1);
    group.quaternion.slerpQuaternions(a.turn, b.turn, place % 1);
    const nearest = place % 1 < 0.5 ? a : b;
    if (nearest.blob) picture.show(nearest);
    stage.draw();
    return nearest;
  };

  // Look from where it is, with its lens.
  const ride = () => {
    const { camera, orbit } = stage;
    camera.fov = 2 * Math.atan(Math.max(lens.down, lens.right / camera.aspect)) * 180 / Math.PI;
    camera.updateProjectionMatrix();
    camera.position.copy(group.position);
    orbit.target.set(0, 0, 0.15 * stage.reach).applyQuaternion(group.quaternion).add(group.position);
    camera.lookAt(orbit.target);
  };
  return { group, moveTo, ride };
}
