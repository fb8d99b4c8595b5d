// The tracks as they came, and the 3D projected onto them.

let sight = null;  // how far the tracks reach
let marks = [];    // joints on this canvas, for pointing at them

const measureImage = () => {
  const reach = [[], []], sizes = [];
  for (const { tracks, count, frames: length } of people) {
    for (let i = 0; i < tracks.length; i++) if (!Number.isNaN(tracks[i])) reach[i % 2].push(tracks[i]);
    const step = Math.max(1, Math.floor(length / SAMPLES));
    for (let t = 0; t < length; t += step) {
      const own = [0, 1].map(a => Array.from({ length: count }, (_, j) => tracks[2 * (t * count + j) + a]).filter(Number.isFinite));
      if (own[0].length) sizes.push(Math.max(...own.map(v => Math.max(...v) - Math.min(...v))));
    }
  }
  sight = { low: reach.map(v => quantile(v, 0.001)), high: reach.map(v => quantile(v, 0.999)), body: quantile(sizes, 0.9) };
};

const drawImage = bodies => {
  const { pen, width, height } = open(byId("image"));
  let { low, high } = sight;
  const projections = bodies.map(({ person, joints, middle }) =>
    project(person, state.frame, middle ? joints.map((v, i) => v + middle[i % 3]) : joints));
  if (state.follow && sight.body > 0) {
    const [x, y] = [0, 1].map(a => {
      const all = projections.flatMap(p => [...p].filter((_, i) => i % 2 === a));
      return (quantile(all, 0.02) + quantile(all, 0.98)) / 2;
    });
    const half = 0.62 * sight.body * (people.length > 1 ? 2 : 1);
    [low, high] = [[x - half, y - half], [x + half, y + half]];
  }
  const scale = 0.9 * Math.min(width / Math.max(high[0] - low[0], 1e-9), height / Math.max(high[1] - low[1], 1e-9));
  const at = (values, j) => [0, 1].map(a => (a ? height : width) / 2 + scale * (values[2 * j + a] - (low[a] + high[a]) / 2));
  marks = [];
  bodies.forEach(({ person }, k) => {
    const first = state.frame * person.count, own = person.tracks.subarray(2 * first, 2 * (first + person.count));
    const seen = j => !Number.isNaN(own[2 * j]);
    const broad = Math.min(Math.max(0.02 * sight.body * scale, person.bones.length ? 1.5 : 3), 4);
    for (const [a, b, side] of person.bones)
      if (seen(a) && seen(b)) stroke(pen, at(own, a), at(own, b), person.colours[side], broad);
    for (const [a, b] of person.bones) {
      const [p, q] = [at(projections[k], a), at(projections[k], b)];
      if (Number.isFinite(p[0] + q[0])) stroke(pen, p, q, "#00000066", 0.8);
    }
    for (let j = 0; j < person.count; j++) {
      const [x, y] = at(seen(j) ? own : projections[k], j), color = person.colours[person.sides[j]];
      if (!Number.isFinite(x)) continue;
      const pointed = state.hover && state.hover.person === person && state.hover.joint === j;
      if (seen(j)) disc(pen, x, y, 0.75 * broad + 0.6, color, "#ffffff");
      else if (!person.blank[state.frame]) disc(pen, x, y, 0.75 * broad + 0.6, "#ffffff", color);
      if (pointed) disc(pen, x, y, 8, null, "#222");
      marks.push({ x, y, person, joint: j });
    }
  });
};
