// Controls, and the loop that plays.

const slider = byId("slider"), play = byId("play"), tip = byId("tip");
const fps = (data.fps || 25) / data.step;  // of the frames shown
const main = document.querySelector("main");
const lengths = new Chart(byId("lengths"), "%"), spread = new Chart(byId("spread"), data.units);

let waiting = false;
const redraw = () => {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; draw(); });
};
const draw = () => {
  const number = state.frame * data.step, bodies = bodiesAt(state.frame);
  byId("frame").textContent = `frame ${number} of ${data.total}` + (data.fps ? ` · ${(number / data.fps).toFixed(2)} s` : "");
  slider.value = state.frame;
  drawSpace(bodies);
  drawImage(bodies);
  const at = state.hover && state.hover.person.number === state.person ? state.hover.joint : -1;
  if (!lengths.section.hidden) lengths.draw(line => line.ends.includes(at));
  if (!spread.section.hidden) spread.draw(line => line.joint === at);
};
const show = frame => { state.frame = ((frame % frames) + frames) % frames; redraw(); };

// What belongs to the clip and not to the frame.
const plot = () => {
  const person = people[state.person], name = j => person.joints[j];
  lengths.set(deviations(person).map((values, k) => {
    const [a, b, side] = person.bones[person.rigid[k]];
    return { name: `${name(a)}-${name(b)}`, ends: [a, b], color: person.colours[side], values };
  }), { least: 1, both: true });
  lengths.section.hidden = !person.rigid.length || frames === 1;
  spread.section.hidden = !person.spread || frames === 1;
  main.dataset.charts = Number(!lengths.section.hidden) + Number(!spread.section.hidden);
  if (person.spread) spread.set(person.joints.map((joint, j) => ({
    name: joint, joint: j, color: person.colours[person.sides[j]],
    values: Float32Array.from({ length: person.frames }, (_, t) => person.spread[t * person.count + j]),
  })), { least: 0.01 * person.size, both: false });
};
const refit = () => { measure(); plot(); redraw(); };

let last = 0, clock = 0;
const tick = now => {
  if (!state.playing) return;
  clock += Math.min(now - last, 500) / 1000 * fps * Number(byId("speed").value);
  last = now;
  const steps = Math.floor(clock);
  clock -= steps;
  if (steps) show(state.frame + steps);
  requestAnimationFrame(tick);
};
const setPlaying = on => {
  state.playing = on;
  play.textContent = on ? "Pause" : "Play";
  if (on) { last = performance.now(); clock = 0; requestAnimationFrame(tick); }
};
const look = view => { [state.yaw, state.pitch] = VIEWS[view]; fit(); redraw(); };

// Point at a joint in either picture.
const point = (canvas, list, e) => {
  const box = canvas.getBoundingClientRect(), [x, y] = [e.clientX - box.left, e.clientY - box.top];
  let best = null, least = 14;
  for (const spot of list) {
    const gap = Math.hypot(spot.x - x, spot.y - y);
    if (gap < least) [best, least] = [spot, gap];
  }
  if (!best && !state.hover) return;
  state.hover = best && { person: best.person, joint: best.joint };
  tip.hidden = !best;
  if (best) {
    const { person, joint } = best, i = state.frame * person.count + joint, weight = person.weights[i] / 255;
    const kind = joint >= person.observed ? "virtual" : weight > 0 ? `confidence ${weight.toFixed(2)}` : "unseen";
    const depth = person.spread ? ` · depth ± ${Number(person.spread[i].toPrecision(2))} ${data.units}` : "";
    tip.textContent = `${people.length > 1 ? `${person.name}: ` : ""}${person.joints[joint]} · ${kind}${depth}`;
    tip.style.left = `${Math.min(e.clientX + 14, innerWidth - tip.offsetWidth - 4)}px`;
    tip.style.top = `${Math.max(e.clientY - 28, 2)}px`;
  }
  redraw();
};
for (const [canvas, list] of [[byId("space"), () => spots], [byId("image"), () => marks]]) {
  canvas.addEventListener("pointermove", e => { if (!e.buttons) point(canvas, list(), e); });
  canvas.addEventListener("pointerdown", e => point(canvas, list(), e));
  canvas.addEventListener("pointerleave", e => point(canvas, [], e));
}

const option = (select, words, k) => {
  const item = document.createElement("option");
  [item.textContent, item.value] = [words, k];
  select.append(item);
};
const listSolutions = () => {
  const select = byId("solution"), person = people[state.person];
  select.replaceChildren();
  person.solutions.forEach((s, k) => option(select, s.label, k));
  select.value = person.chosen;
  byId("pick-solution").hidden = person.solutions.length < 2;
};
const toggle = (id, after) => byId(id).addEventListener("change", e => { state[id] = e.target.checked; after(); });

slider.max = frames - 1;
slider.addEventListener("input", () => { setPlaying(false); show(Number(slider.value)); });
play.addEventListener("click", () => setPlaying(!state.playing));
toggle("mirror", () => { plot(); redraw(); });
toggle("follow", refit);
toggle("walk", refit);
toggle("bars", redraw);
toggle("names", redraw);
people.forEach((p, k) => option(byId("person"), p.name, k));
byId("person").addEventListener("change", e => { state.person = Number(e.target.value); listSolutions(); plot(); redraw(); });
byId("solution").addEventListener("change", e => { people[state.person].chosen = Number(e.target.value); plot(); redraw(); });
document.querySelectorAll("[data-view]").forEach(b => b.addEventListener("click", () => look(b.dataset.view)));
document.addEventListener("keydown", e => {
  if (e.ctrlKey || e.altKey || e.metaKey) return;
  if (e.key === " " && !e.target.matches("button, select, input[type=checkbox]")) { e.preventDefault(); setPlaying(!state.playing); }
  if (e.key === "m" && !e.target.matches("select")) byId("mirror").click();
  const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
  if (!step || e.target.matches("select")) return;
  e.preventDefault();
  setPlaying(false);
  show(state.frame + step * (e.shiftKey ? 10 : 1));
});

play.parentElement.hidden = frames === 1;
byId("pick-speed").hidden = frames === 1;
byId("pick-person").hidden = people.length < 2;
byId("pick-walk").hidden = !people.some(p => p.path);
byId("pick-bars").hidden = !people.some(p => p.spread);
if (!byId("notes").querySelector("li")) byId("notes").remove();
for (const side of ["left", "right"]) if (people.some(p => p.bones.some(b => b[2] === side))) {
  const item = document.createElement("li"), key = document.createElement("i");
  key.style.background = data.colours[side];
  item.append(key, side);
  byId("legend").append(item);
}
listSolutions();
listenSpace(byId("space"), redraw);
measureImage();
[state.yaw, state.pitch] = VIEWS.three;
measure();
// A body that goes far would be small.
if (people.length === 1 && room.size > 2.5 * people[0].size) byId("follow").checked = state.follow = true;
refit();
let size = "";
const resized = new ResizeObserver(() => {  // a picture of another shape is filled anew
  const now = `${byId("space").clientWidth} ${byId("space").clientHeight}`;
  if (size && now !== size) fit();
  size = now;
  redraw();
});
document.querySelectorAll("canvas").forEach(canvas => resized.observe(canvas));
// For scripts and for tests of the page.
window.player = {
  state, show, play: () => setPlaying(true), pause: () => setPlaying(false),
  joints: k => Array.from(place(people[k], state.frame)),
  image: k => Array.from(project(people[k], state.frame, place(people[k], state.frame))),
  spots: () => spots.map(({ x, y, person, joint }) => ({ x, y, name: person.joints[joint] })),
};
