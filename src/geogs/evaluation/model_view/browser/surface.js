// The mesh: with an image of it or in the colours of the images, plain, or in those of its errors. What turns its back, or
// is in the way, is a veil, so that one looks into a room from outside.

const VERTEX = `
  attribute vec3 tint; varying vec3 vTint; varying vec3 vNormal; varying vec3 vView; varying vec3 vPlace;
  varying vec2 vSheet;
  void main() {
    vec4 place = modelViewMatrix * vec4(position, 1.0);
    vTint = tint; vNormal = normalMatrix * normal; vView = -place.xyz; vPlace = position; vSheet = uv;
    gl_Position = projectionMatrix * place;
  }`;

const FRAGMENT = `
  uniform float strength; uniform bool plain; uniform bool veil; uniform bool sheet; uniform sampler2D image;
  varying vec2 vSheet;
  varying vec3 vTint; varying vec3 vNormal; varying vec3 vView; varying vec3 vPlace;
  ${IN_THE_WAY}
  void main() {
    if ((gl_FrontFacing && !isInTheWay(vPlace)) == veil) discard;
    vec3 n = normalize(vNormal) * (gl_FrontFacing ? 1.0 : -1.0);
    float head = max(dot(n, normalize(vView)), 0.0);
    float lamp = max(dot(n, normalize(vec3(-0.35, 0.8, 0.5))), 0.0);
    float light = 1.0 - strength + strength * (0.55 * head + 0.6 * lamp);
    vec3 colour = plain ? vec3(0.80, 0.81, 0.83) : sheet ? texture2D(image, vSheet).rgb : vTint;
    if (veil) gl_FragColor = vec4(mix(colour, vec3(0.62, 0.68, 0.76), 0.6), 0.07 + 0.08 * pow(1.0 - head, 2.0));
    else gl_FragColor = vec4(colour * light, 1.0);
  }`;

async function sheetOf(packed) {
  if (!packed || !packed.texture) return null;
  const [start, size] = packed.texture;
  const jpeg = embedded('model-images').subarray(start, start + size);
  const sheet = new THREE.Texture(await createImageBitmap(new Blob([jpeg], { type: 'image/jpeg' })));
  sheet.flipY = false;
  sheet.needsUpdate = true;
  return sheet;
}

function makeSurface(packed, content, room, sheet) {
  const geometry = new THREE.BufferGeometry();
  const vertices = lengths(unpacked(content, packed.vertices), packed.box);
  const faces = unpacked(content, packed.faces);
  for (let i = 0; i < faces.length; i += 3) {
    faces[i + 1] += faces[i];
    faces[i + 2] += faces[i];
  }
  geometry.setAttribute('position', new THREE.BufferAttribute(vertices, 3));
  geometry.setIndex(new THREE.BufferAttribute(faces, 1));
  const normals = Int8Array.from(unpacked(content, packed.normals), (byte) => byte - 128);
  geometry.setAttribute('normal', new THREE.BufferAttribute(normals, 3, true));
  geometry.computeBoundingSphere();

  const looks = new Map();
  // The light is in the images already; a little shading tells slopes where colour does not.
  if (sheet) {
    geometry.setAttribute('uv', new THREE.BufferAttribute(unpacked(content, packed.uv), 2, true));
    looks.set('Colour', { colour: null, legend: null, strength: 0.12, isSheet: true });
  }
  for (const { name, colours, legend } of packed.colourings) {
    const rgb = unpacked(content, colours);
    const strength = legend ? 0.45 : 0.22;
    looks.set(name, { colour: new THREE.BufferAttribute(rgb, 3, true), legend, strength });
  }
  looks.set('Shape', { colour: null, legend: null, strength: 0.8 });

  const shared = {
    strength: { value: 0.2 }, plain: { value: false }, sheet: { value: false },
    image: { value: sheet }, ...room.uniforms,
  };
  const made = (veil) => new THREE.Mesh(geometry, new THREE.ShaderMaterial({
    vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: { ...shared, veil: { value: veil } },
    side: veil ? THREE.DoubleSide : THREE.FrontSide, transparent: veil, depthWrite: !veil,
  }));
  const solid = made(false), group = new THREE.Group();
  group.add(solid, made(true));
  const look = (name) => {
    const { colour, strength, isSheet } = looks.get(name);
    if (colour) geometry.setAttribute('tint', colour);
    shared.sheet.value = Boolean(isSheet);
    shared.plain.value = !colour && !isSheet;
    shared.strength.value = strength;
    return looks.get(name);
  };
  // Where a ray meets what is not a veil.
  const meet = (ray) => {
    const hit = ray.intersectObject(solid).find(({ point }) => !room.isInTheWay(point));
    return hit && hit.point;
  };
  return { group, looks, look, meet };
}
