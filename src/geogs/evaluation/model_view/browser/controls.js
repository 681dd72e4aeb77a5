// Buttons, legend, and the strip of keyframes.

const element = (tag, attributes = {}, text = '') => {
  const made = Object.assign(document.createElement(tag), attributes);
  made.textContent = text;
  return made;
};

function segmented(box, names, chosen, choose) {
  const buttons = names.map((name) => {
    const button = element('button', { type: 'button', onclick: () => pick(name) }, name);
    box.append(button);
    return button;
  });
  const pick = (name) => {
    buttons.forEach((b) => b.setAttribute('aria-pressed', String(b.textContent === name)));
    choose(name);
  };
  pick(chosen);
}

function toggle(box, name, on, change) {
  const button = element('button', { type: 'button' }, name);
  const set = (value) => {
    button.setAttribute('aria-pressed', String(value));
    change(value);
  };
  button.onclick = () => set(button.getAttribute('aria-pressed') !== 'true');
  box.append(button);
  set(on);
}

function showLegend(box, legend) {
  box.hidden = !legend;
  if (!legend) return;
  box.replaceChildren(element('b', {}, legend.title));
  const bar = element('i');
  bar.style.background = `linear-gradient(90deg, ${legend.stops.join(',')})`;
  const ends = element('span');
  ends.append(...legend.ends.map((end) => element('em', {}, end)));
  box.append(bar, ends);
  if (legend.note) box.append(element('small', {}, legend.note));
}

// A strip of images below; a click shows a keyframe where it is, another one looks from there.
function makeStrip(box, keyframes, pick) {
  const cells = new Map();
  const seen = new IntersectionObserver((entries) => entries.forEach(({ isIntersecting, target }) => {
    if (!isIntersecting) return;
    seen.unobserve(target);
    const image = target.firstChild;
    image.onload = () => URL.revokeObjectURL(image.src);
    image.src = URL.createObjectURL(target.keyframe.blob);
  }), { root: box, rootMargin: '0px 400px' });
  for (const keyframe of keyframes.filter((k) => k.blob)) {
    const cell = element('button', { type: 'button', title: keyframe.name });
    cell.keyframe = keyframe;
    cell.append(element('img', { alt: '' }));
    cell.onclick = () => pick(keyframe);
    cells.set(keyframe, cell);
    box.append(cell);
    seen.observe(cell);
  }
  box.hidden = !cells.size;
  return (keyframe) => {
    cells.forEach((cell, k) => cell.setAttribute('aria-pressed', String(k === keyframe)));
    const cell = cells.get(keyframe);
    if (cell) {
      box.scrollTo({ left: cell.offsetLeft - box.clientWidth / 2 + cell.clientWidth / 2,
        behavior: 'smooth' });
    }
  };
}
