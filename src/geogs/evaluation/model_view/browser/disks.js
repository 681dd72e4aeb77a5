// The disks as flat ellipses out to one and a half deviations, coloured by where they face; not seen from
// behind.

function makeDisks(packed, content, room) {
  const count = packed.position[1];
  const turns = Float32Array.from(unpacked(content, packed.quaternion), (v) => (v - 128) / 127);
  const [low, high] = packed.logs;
  const scales = Float32Array.from(unpacked(content, packed.scale),
    (v) => Math.exp(low + (v / 255) * (high - low)));
  const geometry = new THREE.InstancedBufferGeometry();
  const square = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0];
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(square), 3));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  const place = lengths(unpacked(content, packed.position), packed.box);
  geometry.setAttribute('centre', new THREE.InstancedBufferAttribute(place, 3));
  geometry.setAttribute('turn', new THREE.InstancedBufferAttribute(turns, 4));
  geometry.setAttribute('size', new THREE.InstancedBufferAttribute(scales, 2));
  geometry.instanceCount = count;
  const material = new THREE.ShaderMaterial({
    vertexShader: `
      attribute vec3 centre; attribute vec4 turn; attribute vec2 size;
      varying vec2 vPlace; varying vec3 vTint; varying vec3 vCentre;
      vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.yzw, cross(q.yzw, v) + q.x * v); }
      void main() {
        vec4 q = normalize(turn);
        vPlace = position.xy; vCentre = centre;
        vTint = 0.52 + 0.38 * turned(q, vec3(0.0, 0.0, 1.0));
        vec3 offset = turned(q, vec3(1.5 * size * position.xy, 0.0));
        gl_Position = projectionMatrix * modelViewMatrix * vec4(centre + offset, 1.0);
      }`,
    fragmentShader: `
      varying vec2 vPlace; varying vec3 vTint; varying vec3 vCentre;
      ${IN_THE_WAY}
      void main() {
        float r = dot(vPlace, vPlace);
        if (r > 1.0 || isInTheWay(vCentre)) discard;
        gl_FragColor = vec4(vTint * (1.0 - 0.45 * smoothstep(0.55, 1.0, r)), 1.0);
      }`,
    uniforms: room.uniforms,
    side: THREE.FrontSide,
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  return mesh;
}
