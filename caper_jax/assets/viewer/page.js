// The page around the view: scenes, sliders, tables, pointer and keys.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const shown = {points: true, boxes: true, axes: true, truth: true, others: true};
const surface = byId("lines");
const layers = new Layers(byId("points"), surface);
let scene, camera, states, waiting = false;

function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    layers.draw(scene, camera, partMotions(scene, states), shown);
  });
}

function element(tag, text, attributes = {}) {
  const made = document.createElement(tag);
  made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

const formatState = (type, state) => type === "revolute"
  ? `${(state * 180 / Math.PI).toFixed(1)}°` : `${(100 * state).toFixed(1)} cm`;
const formatSize = (size) => size.map((extent) => (100 * extent).toFixed(1)).join(" × ");

function choose(index) {
  const source = data.scenes[index];
  scene = {...source, edges: data.edges, faces: data.faces};
  scene.points = decodeFloats(source.points);
  const corners = scene.estimate.corners.flat();
  const target = mean(corners);
  const radius = Math.max(...corners.map((corner) => Math.hypot(...subtract(corner, target))));
  scene.pointSize = 0.018 * radius;
  camera = new Camera(target, scene.up, radius);
  states = [...scene.estimate.state];
  layers.load(scene);
  [...byId("scenes").children].forEach((button, i) =>
    button.setAttribute("aria-pressed", String(i === index)));
  byId("truth-toggle").hidden = !scene.truth;
  byId("others-toggle").hidden = !scene.others.length;
  byId("others-toggle").querySelector("span").textContent = "Other readings: " +
    scene.others.map(({probability}) => `${Math.round(100 * probability)} %`).join(", ");
  byId("warning").hidden = !scene.warning;
  byId("warning").textContent = `Do not believe this: ${scene.warning}`;
  byId("input").hidden = !scene.image;
  if (scene.image) byId("input").querySelector("img").src = scene.image;
  fillJoints();
  fillParts();
  redraw();
}

function fillJoints() {
  const place = byId("joints");
  place.replaceChildren(...scene.joints.map((joint, j) => {
    const box = element("div", "", {class: "joint"});
    const row = element("div", "", {class: "row"});
    const id = `joint-${j}`;
    const value = element("output", "", {for: id});
    row.append(element("label", joint.name, {for: id}), value);
    const slider = element("input", "", {
      type: "range", id, min: joint.limits[0], max: joint.limits[1], step: "any",
    });
    const show = () => {
      slider.value = states[j];
      value.textContent = formatState(joint.type, states[j]);
      byId("reset-joints").disabled = states.every((s, i) => s === scene.estimate.state[i]);
    };
    slider.addEventListener("input", () => {
      states[j] = Number(slider.value);
      show();
      redraw();
    });
    box.show = show;
    const known = [`estimate ${formatState(joint.type, scene.estimate.state[j])}`];
    if (scene.truth) known.push(`truth ${formatState(joint.type, scene.truth.state[j])}`);
    box.append(row, slider, element("small", [joint.type, ...known].join(", ")));
    for (const [label, [axis, pivot]] of Object.entries(joint.errors)) {
      const texts = [`axis ${axis}`, ...(pivot === "-" ? [] : [`pivot ${pivot}`])];
      box.append(element("small", `${label}: ${texts.join(", ")}`));
    }
    return box;
  }));
  for (const box of place.children) box.show();
}

function fillParts() {
  const table = byId("parts");
  const head = element("tr", "");
  head.append(element("th", ""), element("th", "Size x × y × z, cm"));
  if (scene.truth) head.append(element("th", "Truth"));
  const body = element("tbody", "");
  scene.parts.forEach((part, k) => {
    const row = element("tr", "");
    const name = element("th", part.name, {scope: "row"});
    name.prepend(element("span", "", {class: "swatch", style: `background:${part.color}`}));
    row.append(name, element("td", formatSize(scene.estimate.size[k])));
    if (scene.truth) row.append(element("td", formatSize(scene.truth.size[k])));
    body.append(row);
    for (const [label, texts] of Object.entries(part.errors)) {
      const extra = element("tr", "");
      extra.append(element("td", ""), element("td", `${label}: ${texts.join(", ")}`,
        {colspan: "2", class: "note"}));
      body.append(extra);
    }
  });
  const top = element("thead", "");
  top.append(head);
  table.replaceChildren(top, body);
}

// Pointers: one turns (or moves, with the right button or shift), two move and pinch.
const pointers = new Map();
surface.addEventListener("pointerdown", (event) => {
  surface.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
});
for (const ending of ["pointerup", "pointercancel"])
  surface.addEventListener(ending, (event) => pointers.delete(event.pointerId));
surface.addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = [event.clientX, event.clientY];
  const dx = now[0] - before[0], dy = now[1] - before[1];
  const height = Math.min(surface.clientHeight, surface.clientWidth);
  if (pointers.size === 1) {
    if (event.shiftKey || event.buttons & 2) camera.pan(dx, dy, height);
    else camera.orbit(0.008 * dx, 0.008 * dy);
  } else {
    const [, other] = [...pointers].find(([id]) => id !== event.pointerId);
    const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    camera.zoom(Math.max(gap(before), 1) / Math.max(gap(now), 1));
    camera.pan(dx / 2, dy / 2, height);
  }
  pointers.set(event.pointerId, now);
  redraw();
});
surface.addEventListener("wheel", (event) => {
  event.preventDefault();
  const lines = event.deltaMode === 1 ? 16 : 1;
  camera.zoom(Math.exp(0.0012 * lines * event.deltaY));
  redraw();
}, {passive: false});
surface.addEventListener("contextmenu", (event) => event.preventDefault());
surface.addEventListener("dblclick", resetView);
surface.addEventListener("keydown", (event) => {
  const step = 0.1;
  const actions = {
    ArrowLeft: () => camera.orbit(-step, 0), ArrowRight: () => camera.orbit(step, 0),
    ArrowUp: () => camera.orbit(0, -step), ArrowDown: () => camera.orbit(0, step),
    "+": () => camera.zoom(0.9), "=": () => camera.zoom(0.9), "-": () => camera.zoom(1.1),
  };
  if (!(event.key in actions)) return;
  event.preventDefault();
  actions[event.key]();
  redraw();
});

function resetView() {
  camera.reset();
  redraw();
}

byId("reset-view").addEventListener("click", resetView);
byId("reset-joints").addEventListener("click", () => {
  states = [...scene.estimate.state];
  for (const box of byId("joints").children) box.show();
  redraw();
});
for (const input of document.querySelectorAll("[data-layer]")) {
  shown[input.dataset.layer] = input.checked;
  input.addEventListener("change", () => {
    shown[input.dataset.layer] = input.checked;
    redraw();
  });
}
byId("scenes").append(...data.scenes.map((entry, index) => {
  const button = element("button", entry.name, {type: "button"});
  button.addEventListener("click", () => choose(index));
  return button;
}));
if (data.scenes.length < 2) byId("scenes").hidden = true;
new ResizeObserver(redraw).observe(byId("stage"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
choose(0);
