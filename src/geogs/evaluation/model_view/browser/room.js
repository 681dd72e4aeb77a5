// Walls and the ceiling are in the way of those who look into a room from outside: what is beyond a
// bound of the room is in the way of an eye that is beyond it, too, but for the floor.

const FAR = 1e30;

const IN_THE_WAY = `
  uniform vec3 low; uniform vec3 high; uniform float ground;
  bool isInTheWay(vec3 place) {
    bvec3 over = greaterThan(min(place, cameraPosition), high);
    bvec3 under = lessThan(max(place, cameraPosition), low);
    return place.y > ground && (any(over) || any(under));
  }`;

function makeRoom(packed, camera) {
  const { low, high, ground } = packed ?? { low: [-FAR, -FAR, -FAR], high: [FAR, FAR, FAR], ground: FAR };
  const uniforms = {
    low: { value: new THREE.Vector3(...low) }, high: { value: new THREE.Vector3(...high) },
    ground: { value: ground },
  };
  const isInTheWay = (place) => place.y > ground && ['x', 'y', 'z'].some((axis, i) =>
    Math.min(place[axis], camera.position[axis]) > high[i]
    || Math.max(place[axis], camera.position[axis]) < low[i]);
  return { uniforms, isInTheWay };
}
