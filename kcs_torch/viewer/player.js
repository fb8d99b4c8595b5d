"use strict";
(() => {
  const scene = JSON.parse(document.getElementById("data").textContent);
  const floats = text => new Float32Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
  const points = floats(scene.points), centres = floats(scene.centres);
  const count = scene.joints.length;
  const byId = id => document.getElementById(id);
  const plot = byId("plot"), slider = byId("slider"), play = byId("play");
  const sides = Object.keys(scene.colours);
  const state = { frame: 0, playing: false, mirror: false, follow: false };
  const box = () => state.follow ? scene.follow : scene.fixed;

  // Joint k of the current frame as [x, y, z]; y is depth, z is up.
  const place = k => {
    const i = 3 * (state.frame * count + k), c = 3 * state.frame;
    const p = [points[i], points[i + 1], points[i + 2]];
    if (state.follow) for (let a = 0; a < 3; a++) p[a] -= centres[c + a];
    if (state.mirror) p[1] = -p[1];
    return p;
  };
  const columns = rows => [0, 1, 2].map(a => rows.map(r => r[a]));
  const GAP = [null, null, null];
  const lines = (bones, joints) => columns(bones.flatMap(([a, b]) => [joints[a], joints[b], GAP]));

  // The traces that move, in the order in which they are drawn: shadow, bones by side, joints.
  const moving = () => {
    const joints = Array.from({ length: count }, (_, k) => place(k));
    const ground = box().ground;
    const flat = joints.map(([x, y]) => [x, y, ground]);
    const every = sides.flatMap(s => scene.bones[s]);
    return [lines(every, flat), ...sides.map(s => lines(scene.bones[s], joints)), columns(joints)];
  };

  const grid = () => {
    const { low, high, ground, grid: step } = box(), rows = [], z = ground - 0.005 * (high[2] - low[2]);
    for (let x = Math.ceil(low[0] / step) * step; x <= high[0]; x += step) rows.push([x, low[1], z], [x, high[1], z], GAP);
    for (let y = Math.ceil(low[1] / step) * step; y <= high[1]; y += step) rows.push([low[0], y, z], [high[0], y, z], GAP);
    return columns(rows);
  };

  const line = (color, width, extra) => ({ type: "scatter3d", mode: "lines", line: { color, width }, hoverinfo: "skip", ...extra });
  const xyz = ([x, y, z]) => ({ x, y, z });
  const traces = () => {
    const [shadow, ...rest] = moving(), joints = rest.pop();
    return [
      line("#cccccc", 2, { showlegend: false, ...xyz(grid()) }),
      line("#aaaaaa", 4, { showlegend: false, ...xyz(shadow) }),
      ...sides.map((s, i) => line(scene.colours[s], 7, { name: s, showlegend: scene.bones[s].length > 0, ...xyz(rest[i]) })),
      {
        type: "scatter3d", mode: "markers", showlegend: false, ...xyz(joints), text: scene.joints,
        hovertemplate: "%{text}<extra></extra>",
        marker: { size: 4, color: scene.sides.map(s => scene.colours[s]), line: { color: "#ffffff", width: 1 } },
      },
    ];
  };
  const MOVING = [1, 2, 3, 4, 5];

  const ratio = () => {
    const { low, high } = box(), size = low.map((l, a) => high[a] - l), most = Math.max(...size);
    return { x: 1.3 * size[0] / most, y: 1.3 * size[1] / most, z: 1.3 * size[2] / most };
  };
  const axis = a => ({
    range: [box().low[a], box().high[a]], autorange: false, visible: false, showspikes: false,
  });
  // Where each view looks from; lengths are 1.
  const VIEWS = { three: [0.47, -0.85, 0.25], camera: [0, -1, 0], side: [1, 0, 0], top: [0, -0.01, 1] };
  const HALF_FIELD = Math.tan(Math.PI / 8);  // of plotly's camera
  const camera = from => {
    const r = ratio(), across = Math.hypot(r.x, r.y) / 2, up = (Math.abs(from[2]) > 0.7 ? r.y : r.z) / 2;
    const half = Math.max(up, across * plot.clientHeight / plot.clientWidth);
    const distance = 1.05 * half / HALF_FIELD + 0.5 * across;  // so that every body fills the page
    const [x, y, z] = from.map(v => v * distance);
    return { eye: { x, y, z }, center: { x: 0, y: 0, z: 0 }, up: { x: 0, y: 0, z: 1 }, projection: { type: "perspective" } };
  };
  const layout = {
    margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: true, uirevision: "kept", paper_bgcolor: "#ffffff",
    legend: { x: 0.01, y: 0.99, itemsizing: "constant", font: { size: 14 } },
    scene: {
      xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), aspectmode: "manual", aspectratio: ratio(),
      camera: camera(VIEWS.three), dragmode: "turntable", uirevision: "kept",
    },
  };

  let busy = false, again = false;
  const draw = () => {
    byId("frame").textContent = `frame ${state.frame} of ${scene.frames}` +
      (scene.clock ? ` · ${(state.frame / scene.fps).toFixed(2)} s` : "");
    slider.value = state.frame;
    if (busy) { again = true; return; }
    busy = true;
    const [x, y, z] = columns(moving());
    Plotly.restyle(plot, { x, y, z }, MOVING).then(() => {
      busy = false;
      if (again) { again = false; draw(); }
    });
  };
  const show = frame => {
    state.frame = ((frame % scene.frames) + scene.frames) % scene.frames;
    draw();
  };

  // Drawing puts the camera back to where it was before a drag, so the motion holds still while one turns it.
  let heldUntil = 0;
  const hold = ms => { heldUntil = performance.now() + ms; };
  plot.addEventListener("pointerdown", () => hold(Infinity), true);
  plot.addEventListener("wheel", () => hold(200), { capture: true, passive: true });
  for (const end of ["pointerup", "pointercancel", "blur"]) window.addEventListener(end, () => hold(100), true);

  let last = 0, clock = 0;
  const tick = now => {
    if (!state.playing) return;
    if (now < heldUntil) last = now;
    clock += (now - last) / 1000 * scene.fps * Number(byId("speed").value);
    last = now;
    const steps = Math.floor(clock);
    clock -= steps;
    if (steps && !busy) show(state.frame + steps); else clock += steps;
    requestAnimationFrame(tick);
  };
  const setPlaying = on => {
    state.playing = on;
    play.textContent = on ? "Pause" : "Play";
    if (on) { last = performance.now(); clock = 0; requestAnimationFrame(tick); }
  };

  // Axes belong to the clip, not to the frame; they change only with what is shown.
  const refit = () => {
    const size = {};
    ["x", "y", "z"].forEach((n, a) => { size[`scene.${n}axis.range`] = [box().low[a], box().high[a]]; });
    const [x, y, z] = columns([grid(), ...moving()]);
    const eye = plot.layout.scene.camera.eye, far = Math.hypot(eye.x, eye.y, eye.z);
    const view = { "scene.aspectratio": ratio(), "scene.camera": camera([eye.x / far, eye.y / far, eye.z / far]) };
    Plotly.update(plot, { x, y, z }, { ...size, ...view }, [0, ...MOVING]);
  };

  slider.max = scene.frames - 1;
  slider.addEventListener("input", () => { setPlaying(false); show(Number(slider.value)); });
  play.addEventListener("click", () => setPlaying(!state.playing));
  byId("mirror").addEventListener("change", e => { state.mirror = e.target.checked; draw(); });
  byId("follow").addEventListener("change", e => { state.follow = e.target.checked; refit(); });
  document.querySelectorAll("[data-view]").forEach(b =>
    b.addEventListener("click", () => Plotly.relayout(plot, { "scene.camera": camera(VIEWS[b.dataset.view]) })));
  document.addEventListener("keydown", e => {
    if (e.target.matches("button, select, input[type=checkbox]") && e.key === " ") return;
    if (e.key === " ") { e.preventDefault(); setPlaying(!state.playing); }
    if (e.target === slider) return;
    if (e.key === "ArrowRight") { setPlaying(false); show(state.frame + 1); }
    if (e.key === "ArrowLeft") { setPlaying(false); show(state.frame - 1); }
  });
  if (!byId("notes").querySelector("li")) byId("notes").remove();
  Plotly.newPlot(plot, traces(), layout, { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["tableRotation"] })
    .then(draw);
})();
