// The distance of two points of the surface that are clicked.

const MARK = 0xffd166;

// Three digits, in the unit in which a length is a number that people say.
function lengthInWords(length, metres) {
  const rounded = (value) => String(Number(value.toPrecision(3)));
  if (!metres) return `${rounded(length)} units`;
  const m = length * metres;
  if (m < 0.01) return `${rounded(1000 * m)} mm`;
  if (m < 1) return `${rounded(100 * m)} cm`;
  return m < 1000 ? `${rounded(m)} m` : `${rounded(m / 1000)} km`;
}

function makeMeasure(stage, surface, { metres, note }) {
  const group = new THREE.Group(), label = part('length'), points = [];
  const over = { depthTest: false, transparent: true };
  const dot = new THREE.SphereGeometry(0.004 * stage.reach, 16, 12);
  stage.world.add(group);
  const clear = () => {
    group.clear();
    points.length = 0;
    label.hidden = true;
  };
  const add = (point) => {
    if (points.length === 2) clear();
    points.push(point);
    const ball = new THREE.Mesh(dot, new THREE.MeshBasicMaterial({ color: MARK, ...over }));
    ball.position.copy(point);
    group.add(ball);
    if (points.length < 2) return;
    const ends = points.flatMap((p) => p.toArray());
    group.add(lines(stage, ends, MARK, { linewidth: 2.5, ...over }));
    label.textContent = lengthInWords(points[0].distanceTo(points[1]), metres);
    label.hidden = false;
  };
  stage.drawn.add(() => {
    if (points.length < 2) return;
    const at = stage.pixel(points[0].clone().lerp(points[1], 0.5));
    label.style.visibility = at ? 'visible' : 'hidden';
    if (at) label.style.transform = `translate(${at[0]}px, ${at[1]}px) translate(-50%, -140%)`;
  });
  let isOn = false;
  stage.clicks.push((x, y) => {
    if (!isOn) return false;
    const point = surface.meet(stage.ray(x, y));
    if (point) add(point);
    stage.draw();
    return true;
  });
  return (on) => {
    isOn = on;
    if (!on) clear();
    stage.box.classList.toggle('measuring', on);
    part('hint').textContent = on ? `Click two points. ${note}` : HINT;
    stage.draw();
  };
}
