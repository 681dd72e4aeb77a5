// The mesh: in the colours of the images, plain, or in those of its errors. Walls are not seen from
// behind, so that one looks into a room from outside.

function makeSurface(packed, content) {
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
  for (const { name, colours, legend } of packed.colourings) {
    const rgb = unpacked(content, colours);
    // The light is in the images already; a little shading tells slopes where colour does not.
    const strength = legend ? 0.45 : 0.22;
    looks.set(name, { colour: new THREE.BufferAttribute(rgb, 3, true), legend, strength });
  }
  looks.set('Shape', { colour: null, legend: null, strength: 0.8 });

  const material = new THREE.ShaderMaterial({
    vertexShader: `
      attribute vec3 tint; varying vec3 vTint; varying vec3 vNormal; varying vec3 vView;
      void main() {
        vec4 place = modelViewMatrix * vec4(position, 1.0);
        vTint = tint; vNormal = normalMatrix * normal; vView = -place.xyz;
        gl_Position = projectionMatrix * place;
      }`,
    fragmentShader: `
      uniform float strength; uniform bool plain;
      varying vec3 vTint; varying vec3 vNormal; varying vec3 vView;
      void main() {
        vec3 n = normalize(vNormal) * (gl_FrontFacing ? 1.0 : -1.0);
        float head = max(dot(n, normalize(vView)), 0.0);
        float lamp = max(dot(n, normalize(vec3(-0.35, 0.8, 0.5))), 0.0);
        float light = 1.0 - strength + strength * (0.55 * head + 0.6 * lamp);
        vec3 colour = plain ? vec3(0.80, 0.81, 0.83) : vTint;
        gl_FragColor = vec4(colour * light, 1.0);
      }`,
    uniforms: { strength: { value: 0.2 }, plain: { value: false } },
    side: THREE.FrontSide,
  });
  const mesh = new THREE.Mesh(geometry, material);
  const look = (name) => {
    const { colour, strength } = looks.get(name);
    if (colour) geometry.setAttribute('tint', colour);
    material.uniforms.plain.value = !colour;
    material.uniforms.strength.value = strength;
    return looks.get(name);
  };
  return { mesh, looks, look, material };
}
