// Buttons and the legend.

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
