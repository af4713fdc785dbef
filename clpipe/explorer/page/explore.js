"use strict";

// The page holds one thing: a configuration, as nested values. The server develops whatever is
// asked of it and remembers no settings, so that pages do not disturb each other.

const byId = (id) => document.getElementById(id);
const copy = (value) => JSON.parse(JSON.stringify(value));
const same = (one, two) => JSON.stringify(one) === JSON.stringify(two);

const state = { image: 0, values: {}, step: "" };
let known; // what the server says at the start
let past = [];
let future = [];
let settingB = null;
let picture = null; // facts, pixels, canvas; and the part that came first, until they are there
let other = null; // what is beside it, and the question that gave it

// Questions.

const ask = async (name, question) => {
  const body = JSON.stringify(question);
  let response;
  try {
    response = await fetch(name, { method: "POST", body });
  } catch {
    throw Object.assign(new Error("clpipe explore has ended; start it again"), { key: "" });
  }
  if (response.ok) return response;
  const said = await response.json().catch(() => ({ error: `status ${response.status}` }));
  throw Object.assign(new Error(said.error), { key: said.key || "" });
};

// Facts and pixels: the length of the facts, the facts, then RGB.
const pictured = async (name, question) => {
  const data = await (await ask(name, question)).arrayBuffer();
  const length = new DataView(data).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const { columns, rows: lines } = facts.part;
  if (!columns || !lines) return { facts, canvas: null };
  const pixels = new Uint8Array(data, 4 + length);
  const image = new ImageData(columns, lines);
  const words = new Uint32Array(image.data.buffer);
  for (let i = 0, at = 0; i < words.length; i += 1, at += 3) {
    words[i] = 0xff000000 | (pixels[at + 2] << 16) | (pixels[at + 1] << 8) | pixels[at];
  }
  const canvas = document.createElement("canvas");
  canvas.width = columns;
  canvas.height = lines;
  canvas.getContext("2d").putImageData(image, 0, 0);
  return { facts, pixels, canvas };
};

// The part of the picture that is on the screen, and by how much it is smaller there.
const window_ = () => {
  if (!picture) return { left: 0, top: 0, width: 1 << 20, height: 1 << 20, by: 4 };
  const { scale, x, y } = seen;
  const [left, top] = [Math.max(Math.floor(-x / scale), 0), Math.max(Math.floor(-y / scale), 0)];
  const [right, bottom] = [Math.ceil((canvas.width - x) / scale), Math.ceil((canvas.height - y) / scale)];
  return { left, top, width: Math.max(right - left, 0), height: Math.max(bottom - top, 0), by: Math.max(Math.round(1 / scale), 1) };
};

const whole = async (facts) => {
  const { pixels, canvas: all } = await pictured("pixels", { number: facts.number });
  return { facts, pixels, canvas: all };
};

const questionOf = (values, truth) => ({ image: state.image, values, step: state.step, truth });

// Developing: one question at a time, and then the latest settings.

let running = false;
let again = false;

const refresh = async () => {
  if (running) {
    again = true;
    return;
  }
  running = true;
  const busy = setTimeout(() => { byId("busy").hidden = false; }, 200);
  try {
    const start = performance.now();
    const of = JSON.stringify(state);
    const question = questionOf(state.values, "");
    const first = await pictured("develop", { ...question, ...window_() });
    const { facts } = first;
    const before = picture && picture.facts;
    const isNew = !before || before.width !== facts.width || before.height !== facts.height || picture.image !== state.image;
    if (isNew) {
      picture = { facts, pixels: null, canvas: null, patch: first, image: state.image };
      fit();
    } else {
      picture = { ...picture, facts, patch: first };
      draw();
    }
    developedOf = question.values;
    complain(null);
    tell(facts, performance.now() - start);
    showControls(facts);
    remember();
    if (!again) {
      picture = { ...(await whole(facts)), image: state.image, of };
      draw();
      drawHistogram();
    }
    if (!again) await refreshOther();
    noiseIsOld();
  } catch (error) {
    complain(error);
  } finally {
    clearTimeout(busy);
    byId("busy").hidden = true;
    running = false;
    document.body.dataset.settled = String(!again);
  }
  if (again) {
    again = false;
    await refresh();
  }
};

const refreshOther = async () => {
  const kind = byId("compare").value;
  if (!kind) {
    other = null;
    return;
  }
  const [values, truth] = kind === "B" ? [settingB, ""] : [state.values, kind];
  const question = JSON.stringify([state.image, state.step, values, truth]);
  if (!other || other.question !== question) {
    const { facts } = await pictured("develop", { ...questionOf(values, truth), left: 0, top: 0, width: 0, height: 0, by: 1 });
    other = { ...(await whole(facts)), question };
  }
  draw();
};

const changed = () => {
  byId("undo").disabled = !past.length;
  byId("redo").disabled = !future.length;
  document.body.dataset.settled = "false";
  refresh();
};

let developedOf = null; // the last values that could be developed

const complain = (error) => {
  if (error && picture && picture.image !== state.image) { // which would be taken for this image
    picture = null;
    byId("status").textContent = "";
    draw();
  }
  byId("problem").hidden = !error;
  byId("problem-text").textContent = error ? error.message : "";
  byId("back").hidden = !developedOf || same(developedOf, state.values);
  for (const row of document.querySelectorAll(".row[data-key]")) {
    row.classList.toggle("bad", Boolean(error && error.key) && row.dataset.key === error.key);
  }
};

const tell = (facts, shown) => {
  const ran = facts.launches.filter((launch) => launch.ms !== null);
  const device = ran.reduce((sum, launch) => sum + launch.ms, 0);
  byId("status").textContent =
    `${facts.width} x ${facts.height} px; on the screen after ${shown.toFixed(0)} ms, ` +
    `of which developed in ${(facts.seconds * 1e3).toFixed(0)} ms, ${device.toFixed(1)} ms on the device` +
    (facts.clipped ? `; ${(facts.clipped * 100).toFixed(2)} % clipped` : "") +
    Object.entries(facts.estimates).map(([step, found]) =>
      `; ${step}: ${Object.entries(found).map(([name, value]) => `${name} ${value.toPrecision(4)}`).join(", ")}`).join("") +
    facts.warnings.map((warning) => `; warning: ${warning}`).join("");
  byId("launches").replaceChildren(...facts.launches.map((launch) => {
    const row = document.createElement("tr");
    const [name, time] = [document.createElement("td"), document.createElement("td")];
    name.textContent = launch.name;
    time.textContent = launch.ms === null ? "not run again" : launch.ms.toFixed(2);
    row.append(name, time);
    return row;
  }));
};

// The picture on the screen. Scale is device pixels for each of the picture's.

const canvas = byId("picture");
const ZOOMS = [0.0625, 0.125, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 6, 8];
const seen = { scale: 1, x: 0, y: 0, fits: true };
let box = null; // [left, top, width, height]

const density = () => window.devicePixelRatio || 1;

const sizeCanvas = () => {
  const { width, height } = canvas.getBoundingClientRect();
  canvas.width = Math.max(Math.round(width * density()), 1);
  canvas.height = Math.max(Math.round(height * density()), 1);
};

const fit = () => {
  if (!picture) return;
  sizeCanvas();
  const { width, height } = picture.facts;
  seen.scale = Math.min(canvas.width / width, canvas.height / height, 8);
  seen.x = (canvas.width - width * seen.scale) / 2;
  seen.y = (canvas.height - height * seen.scale) / 2;
  seen.fits = true;
  draw();
};

const zoomTo = (scale, x = canvas.width / 2, y = canvas.height / 2) => {
  const to = Math.min(Math.max(scale, ZOOMS[0]), ZOOMS.at(-1));
  seen.x = x - (x - seen.x) * to / seen.scale;
  seen.y = y - (y - seen.y) * to / seen.scale;
  if (to >= 1) [seen.x, seen.y] = [Math.round(seen.x), Math.round(seen.y)];
  seen.scale = to;
  seen.fits = false;
  draw();
};

const zoomBy = (direction, x, y) => {
  const near = direction > 0 ? ZOOMS.find((zoom) => zoom > seen.scale * 1.001) : ZOOMS.findLast((zoom) => zoom < seen.scale * 0.999);
  if (near) zoomTo(near, x, y);
};

const splitAt = () => canvas.width * Number(byId("split").value) / 100;

const draw = () => {
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, canvas.width, canvas.height);
  if (!picture) return;
  context.imageSmoothingEnabled = seen.scale < 1;
  context.imageSmoothingQuality = "high";
  const put = ({ canvas: drawn, facts, patch }) => {
    if (drawn) context.drawImage(drawn, seen.x, seen.y, facts.width * seen.scale, facts.height * seen.scale);
    if (!patch || !patch.canvas) return;
    const { left, top, width, height } = patch.facts.part;
    context.drawImage(patch.canvas, seen.x + left * seen.scale, seen.y + top * seen.scale, width * seen.scale, height * seen.scale);
  };
  put(picture);
  if (other && byId("compare").value) {
    const split = splitAt();
    context.save();
    context.beginPath();
    context.rect(split, 0, canvas.width - split, canvas.height);
    context.clip();
    context.clearRect(split, 0, canvas.width - split, canvas.height);
    put(other);
    context.restore();
    context.fillStyle = "#fff";
    context.fillRect(split - 1, 0, 2, canvas.height);
    label(context, byId("compare").selectedOptions[0].textContent, split + 8, "left");
    label(context, "this", split - 8, "right");
  }
  if (box) {
    context.strokeStyle = "#fff";
    context.lineWidth = 3;
    const rect = [seen.x + box[0] * seen.scale, seen.y + box[1] * seen.scale, box[2] * seen.scale, box[3] * seen.scale];
    context.strokeRect(...rect);
    context.strokeStyle = "#000";
    context.lineWidth = 1;
    context.strokeRect(...rect);
  }
  byId("zoom").textContent = `${Number((seen.scale * 100).toPrecision(3))} %`;
};

const label = (context, text, x, align) => {
  context.font = `${13 * density()}px system-ui, sans-serif`;
  context.textAlign = align;
  context.textBaseline = "bottom";
  context.lineWidth = 3;
  context.strokeStyle = "#000";
  context.strokeText(text, x, canvas.height - 8);
  context.fillStyle = "#fff";
  context.fillText(text, x, canvas.height - 8);
};

const onCanvas = (event) => {
  const rect = canvas.getBoundingClientRect();
  return [(event.clientX - rect.left) * density(), (event.clientY - rect.top) * density()];
};

const inPicture = ([x, y]) => [Math.floor((x - seen.x) / seen.scale), Math.floor((y - seen.y) / seen.scale)];

let drag = null;
const POINTERS = new Map(); // of two fingers

canvas.addEventListener("pointerdown", (event) => {
  if (!picture) return;
  canvas.setPointerCapture(event.pointerId);
  const at = onCanvas(event);
  POINTERS.set(event.pointerId, at);
  const draws = event.shiftKey || byId("rectangle").getAttribute("aria-pressed") === "true";
  const splits = other && byId("compare").value && Math.abs(at[0] - splitAt()) < 10 * density();
  drag = { kind: draws ? "box" : splits ? "split" : "move", at, from: inPicture(at), x: seen.x, y: seen.y };
});

canvas.addEventListener("pointermove", (event) => {
  if (!picture) return;
  const at = onCanvas(event);
  if (POINTERS.has(event.pointerId)) {
    if (POINTERS.size === 2) pinch(event.pointerId, at);
    POINTERS.set(event.pointerId, at);
  }
  const near = other && byId("compare").value && Math.abs(at[0] - splitAt()) < 10 * density();
  canvas.classList.toggle("splitting", Boolean(near));
  if (drag && POINTERS.size < 2) {
    if (drag.kind === "move") {
      seen.x = drag.x + at[0] - drag.at[0];
      seen.y = drag.y + at[1] - drag.at[1];
      seen.fits = false;
    } else if (drag.kind === "split") {
      byId("split").value = 100 * at[0] / canvas.width;
    } else {
      setBox(drag.from, inPicture(at));
    }
    draw();
  }
  readPixel(inPicture(at));
});

const pinch = (id, at) => {
  const [two] = [...POINTERS].filter(([key]) => key !== id).map(([, place]) => place);
  const before = POINTERS.get(id);
  const distance = (one) => Math.hypot(one[0] - two[0], one[1] - two[1]);
  zoomTo(seen.scale * distance(at) / Math.max(distance(before), 1), (at[0] + two[0]) / 2, (at[1] + two[1]) / 2);
};

const release = (event) => {
  POINTERS.delete(event.pointerId);
  if (drag && drag.kind === "box" && box) measure();
  drag = null;
};
canvas.addEventListener("pointerup", release);
canvas.addEventListener("pointercancel", release);
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoomBy(-event.deltaY, ...onCanvas(event));
}, { passive: false });

canvas.addEventListener("keydown", (event) => {
  const step = 40 * density();
  const moves = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
  const zooms = { "+": () => zoomBy(1), "=": () => zoomBy(1), "-": () => zoomBy(-1), 0: fit, 1: () => zoomTo(1), 8: () => zoomTo(8) };
  if (moves[event.key]) {
    seen.x += moves[event.key][0];
    seen.y += moves[event.key][1];
    draw();
  } else if (zooms[event.key] && !event.ctrlKey && !event.metaKey) {
    zooms[event.key]();
  } else return;
  event.preventDefault();
});

new ResizeObserver(() => {
  if (seen.fits) fit();
  else {
    sizeCanvas();
    draw();
  }
}).observe(canvas);

// Values under the pointer: of eight bits those on the screen, of floats as they are computed.

let asked = null;

const readPixel = async ([x, y]) => {
  const { facts, pixels } = picture;
  if (!pixels || x < 0 || y < 0 || x >= facts.width || y >= facts.height) {
    byId("pixel").textContent = "\u00a0";
    return;
  }
  const place = `x ${x}, y ${y}: `;
  const eight = (shown) => [0, 1, 2].map((c) => shown[3 * (y * facts.width + x) + c]).join(", ");
  const beside = other && byId("compare").value && other.facts.width === facts.width && other.facts.height === facts.height
    ? ` (beside: ${eight(other.pixels)})` : "";
  if (facts.kind === "display") {
    byId("pixel").textContent = `${place}R, G, B ${eight(pixels)}${beside}`;
    return;
  }
  const waits = Boolean(asked);
  asked = [facts.number, x, y];
  if (waits) return;
  while (asked) {
    const [number, atX, atY] = asked;
    try {
      const found = await (await ask("values", { number, x: atX, y: atY })).json();
      byId("pixel").textContent = `x ${atX}, y ${atY}: ${found.values.map((value) => value.toPrecision(5)).join(", ")} (${found.unit})`;
    } catch (error) {
      byId("pixel").textContent = error.message;
    }
    if (asked[1] === atX && asked[2] === atY) asked = null;
  }
};

const drawHistogram = () => {
  const counts = [new Uint32Array(256), new Uint32Array(256), new Uint32Array(256)];
  const { pixels } = picture;
  for (let i = 0; i < pixels.length; i += 3) {
    counts[0][pixels[i]] += 1;
    counts[1][pixels[i + 1]] += 1;
    counts[2][pixels[i + 2]] += 1;
  }
  const area = byId("histogram");
  const context = area.getContext("2d");
  context.clearRect(0, 0, area.width, area.height);
  // The ends are left out of the scale: what is clipped would hide the rest.
  const top = Math.max(...counts.map((each) => each.slice(1, 255).reduce((a, b) => Math.max(a, b), 1)));
  context.globalCompositeOperation = "source-over";
  ["#d13b3b", "#2e9e4f", "#3b6fd1"].forEach((colour, channel) => {
    context.fillStyle = colour;
    context.globalAlpha = 0.55;
    counts[channel].forEach((count, value) => {
      const high = Math.min(Math.sqrt(count / top), 1) * area.height;
      context.fillRect(value * 2, area.height - high, 2, high);
    });
  });
  const share = (value) => counts.map((each) => `${(300 * each[value] / pixels.length).toFixed(2)} %`).join(", ");
  byId("histogram-text").textContent = `At 0: ${share(0)}; at 255: ${share(255)} (R, G, B). Heights are square roots of counts.`;
};

// The noise of a rectangle.

const setBox = ([x0, y0], [x1, y1]) => {
  const limit = (value, most) => Math.min(Math.max(value, 0), most);
  const { width, height } = picture.facts;
  const [left, right] = [Math.min(x0, x1), Math.max(x0, x1)].map((x) => limit(x, width));
  const [top, bottom] = [Math.min(y0, y1), Math.max(y0, y1)].map((y) => limit(y, height));
  box = [left, top, Math.max(right - left, 2), Math.max(bottom - top, 2)];
  ["left", "top", "width", "height"].forEach((id, i) => { byId(id).value = box[i]; });
};

let measuring = false;
let measuredOf = "";

const measure = async () => {
  if (measuring || !picture) return;
  measuring = true;
  byId("measured").textContent = "measuring …";
  const question = JSON.stringify([state, box]);
  try {
    const [left, top, width, height] = box;
    const answer = await (await ask("noise", { image: state.image, values: state.values, step: state.step, left, top, width, height })).json();
    const { channels, kind } = answer.report;
    const scale = kind === "display" ? 255 : 1;
    byId("noise-table").hidden = false;
    byId("noise-table").tBodies[0].replaceChildren(...Object.entries(channels).map(([name, channel]) => {
      const row = document.createElement("tr");
      const table = channel.autocorrelation;
      const middle = (table.length - 1) / 2;
      const figures = [channel.sigma * scale, table[middle][middle + 1], channel.energy_left_2x2, channel.excess_kurtosis];
      const cells = [name, ...figures.map((value) => value === null ? "-" : Number(value.toPrecision(4)))];
      row.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
      return row;
    }));
    const drawn = new DOMParser().parseFromString(answer.svg, "image/svg+xml").documentElement;
    drawn.setAttribute("xmlns", "http://www.w3.org/2000/svg");
    byId("noise-plot").replaceChildren(document.importNode(drawn, true));
    measuredOf = question;
    byId("measured").textContent = `${(answer.report.share_used * 100).toFixed(0)} % of it counts; sigma ${scale === 255 ? "of 255" : answer.report.unit}`;
  } catch (error) {
    byId("measured").textContent = error.message;
    measuredOf = "";
  } finally {
    measuring = false;
  }
};

let remeasure = 0;
const noiseIsOld = () => {
  clearTimeout(remeasure);
  if (measuredOf && measuredOf !== JSON.stringify([state, box])) {
    byId("measured").textContent = "of the settings before";
    remeasure = setTimeout(measure, 700);
  }
};

byId("measure").addEventListener("click", () => {
  if (!picture) return;
  const [left, top, width, height] = ["left", "top", "width", "height"].map((id) => Math.round(Number(byId(id).value)));
  setBox([left, top], [left + width, top + height]);
  draw();
  measure();
});
byId("rectangle").addEventListener("click", (event) => {
  const on = event.currentTarget.getAttribute("aria-pressed") !== "true";
  event.currentTarget.setAttribute("aria-pressed", on);
  canvas.classList.toggle("drawing", on);
});

// Settings, their past and their future.

let lastKey = "";

const setValues = (values, key = "") => {
  if (same(values, state.values)) return;
  if (!key || key !== lastKey) past.push(state.values);
  if (past.length > 500) past.shift();
  future = [];
  lastKey = key;
  state.values = values;
  changed();
};

const set = (key, value, moving = false) => {
  const values = copy(state.values);
  const [table, name] = key.includes(".") ? key.split(".") : [null, key];
  if (table === null) {
    if (value === null) delete values[name];
    else values[name] = value;
  } else {
    const own = name === "method" ? {} : { ...values[table] };
    if (value === null) delete own[name];
    else own[name] = value;
    if (Object.keys(own).length) values[table] = own;
    else delete values[table];
  }
  setValues(values, moving ? key : "");
};

const step = (from, to) => {
  if (!from.length) return;
  to.push(state.values);
  state.values = from.pop();
  lastKey = "";
  changed();
};

byId("back").addEventListener("click", () => setValues(developedOf));

// The keys [ and ] go through the stages.
document.addEventListener("keydown", (event) => {
  const way = { "[": -1, "]": 1 }[event.key];
  if (!way || event.target.matches('input[type="text"], input[type="number"]')) return;
  const { options } = byId("step");
  const order = [...[...options].slice(1), options[0]]; // the picture is the last
  const next = order[order.findIndex((each) => each.selected) + way];
  if (!next) return;
  state.step = next.value;
  changed();
});

byId("undo").addEventListener("click", () => step(past, future));
byId("redo").addEventListener("click", () => step(future, past));
document.addEventListener("keydown", (event) => {
  const isText = event.target.matches('input[type="text"], input[type="number"]');
  if (isText || !(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z") return;
  event.preventDefault();
  if (event.shiftKey) step(future, past);
  else step(past, future);
});

let remembering = 0;
const remember = () => {
  clearTimeout(remembering);
  remembering = setTimeout(() => history.replaceState(null, "", `#${encodeURIComponent(JSON.stringify(state))}`), 300);
};

// Controls. Each is made once from what the server declares; then only its value changes.

const made = (tag, properties = {}, ...children) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
};

const typeOf = (schema) => (schema.anyOf || [schema]).find((each) => each.type !== "null") || schema;

const limitsOf = (schema, value) => {
  const type = typeOf(schema);
  const low = type.minimum ?? type.exclusiveMinimum;
  const high = type.maximum ?? type.exclusiveMaximum;
  const size = Math.abs(Number(value)) || 0;
  const top = high === undefined || (size > 0 && high > 40 * size) ? (size ? 4 * size : 1) : high;
  // A slider over all that is allowed would be too coarse.
  const to = size || low === undefined || low >= 0 ? top : Math.min(top, 5);
  return { low, high, from: Math.max(low ?? -to, size || low >= 0 ? -Infinity : -to), to };
};

// The limits of a number in words.
const between = (type) => {
  const { minimum, exclusiveMinimum, maximum, exclusiveMaximum } = type;
  const low = minimum !== undefined ? `from ${minimum}` : exclusiveMinimum !== undefined ? `above ${exclusiveMinimum}` : "";
  const high = maximum !== undefined ? `to ${maximum}` : exclusiveMaximum !== undefined ? `below ${exclusiveMaximum}` : "";
  const text = [low, high].filter(Boolean).join(" ");
  return text && `${text[0].toUpperCase()}${text.slice(1)}.`;
};

let count = 0;

// A row: the name, what sets it, and a button that leaves it to the camera again.
const row = (key, name, schema, resolved) => {
  const type = typeOf(schema);
  const id = `set-${count += 1}`;
  const inputs = made("span", { className: "inputs" });
  const auto = made("button", { className: "auto", type: "button", textContent: "auto", title: "Leave it out, as it was not set" });
  auto.setAttribute("aria-label", `auto: ${name}`);
  const element = made("div", { className: "row" },
    made("div", { className: "line" }, made("label", { htmlFor: id, textContent: name + (schema.unit ? ` (${schema.unit})` : "") }), inputs, auto));
  const help = [schema.text, between(type), schema.auto ? `Automatic: ${schema.auto}.` : ""].filter(Boolean).join(" ");
  if (help) element.append(made("p", { className: "help", id: `${id}-help`, textContent: help }));
  element.dataset.key = key;
  let field;
  let slider = null;
  if (type.enum || schema.options) {
    field = made("select", {}, ...(schema.options || type.enum.map((each) => ({ value: each, label: String(each) }))).map((each) => new Option(each.label, each.value)));
    field.addEventListener("change", () => set(key, field.value));
  } else if (type.type === "boolean") {
    field = made("input", { type: "checkbox" });
    field.addEventListener("change", () => set(key, field.checked));
  } else if (type.type === "number" || type.type === "integer") {
    const whole = type.type === "integer";
    const limits = limitsOf(schema, resolved ?? schema.default);
    field = made("input", { type: "number", step: whole ? 1 : "any" });
    if (limits.low !== undefined) field.min = limits.low;
    if (limits.high !== undefined) field.max = limits.high;
    field.addEventListener("change", () => set(key, field.value === "" ? null : Number(field.value)));
    if (!schema.plain && limits.to > limits.from) {
      const log = schema.log;
      const place = (value) => log ? Math.log2(value) : value;
      slider = made("input", { type: "range", min: place(limits.from), max: place(limits.to), step: whole && !log ? 1 : "any" });
      slider.setAttribute("aria-label", `${name}, slider`);
      const at = () => {
        const value = log ? 2 ** Number(slider.value) : Number(slider.value);
        return whole || (log && value > 20) ? Math.round(value) : Number(value.toPrecision(4));
      };
      slider.place = place;
      slider.addEventListener("input", () => { set(key, at(), true); field.value = at(); });
      slider.addEventListener("change", () => { lastKey = ""; });
      inputs.append(slider);
    }
  } else {
    field = made("input", { type: "text", placeholder: schema.placeholder || "" });
    field.addEventListener("change", () => set(key, parsed(field.value, type)));
  }
  field.id = id;
  if (help) field.setAttribute("aria-describedby", `${id}-help`);
  inputs.append(field);
  auto.addEventListener("click", () => set(key, null));
  element.show = (value, isSet) => {
    element.classList.toggle("set", isSet);
    auto.hidden = !isSet;
    if (document.activeElement === field && field.type !== "checkbox" && field.tagName !== "SELECT") return;
    if (field.type === "checkbox") field.checked = Boolean(value);
    else if (field.type === "number") field.value = value === null || value === undefined ? "" : Number(Number(value).toPrecision(6));
    else field.value = value === null || value === undefined ? "" : typeof value === "object" ? JSON.stringify(value) : value;
    if (slider && document.activeElement !== slider) slider.value = slider.place(Number(value ?? 0));
  };
  return element;
};

const parsed = (text, type) => {
  if (text === "") return null;
  if (type.type !== "array" && !type.anyOf) return text;
  try {
    return JSON.parse(text);
  } catch {
    return text; // the server says what is wrong with it
  }
};

let isoRow = null;
let isoCamera = "";
let structure = "";
const rows = []; // a key may have several

const keyRow = (key, name, schema, value) => {
  const element = row(key, name, schema, value);
  rows.push(element);
  return element;
};

const makeKeys = (facts) => {
  const camera = keyRow("camera", "camera", { options: known.cameras });
  isoRow = made("div");
  const switchRow = made("div", { className: "row" });
  const noise = made("input", { type: "checkbox", id: "noise-on" });
  noise.addEventListener("change", () => {
    const skip = (state.values.skip || []).filter((name) => name !== "noise");
    set("skip", noise.checked ? (skip.length ? skip : null) : [...skip, "noise"]);
  });
  switchRow.append(made("div", { className: "line" }, made("label", { htmlFor: "noise-on", textContent: "noise" }), noise));
  const exposure = facts.steps.find((each) => each.name === "exposure" && "ev" in each.values);
  const methods = exposure ? known.stages.exposure.methods : [];
  const ev = methods.filter((method) => method.name === exposure.method).map((method) => method.parameters.ev);
  byId("keys").replaceChildren(camera, isoRow, switchRow,
    ...ev.map((schema) => keyRow("exposure.ev", "exposure", schema, 0)),
    ...Object.entries(known.keys).map(([key, schema]) => keyRow(key, key.replaceAll("_", " "), schema, 0)));
  isoCamera = "";
};

const makeStages = (facts) => {
  const opened = new Set([...document.querySelectorAll("#stages details[open]")].map((each) => each.dataset.step));
  // A raw enters behind the first ones; and without noise there are no stages of noise.
  byId("stages").replaceChildren(...facts.steps.filter((each) => each.here || !each.on).map((each) => {
    const declared = known.stages[each.stage];
    const chosen = declared.methods.find((method) => method.name === each.method) || declared.methods[0];
    const toggle = made("input", { type: "checkbox", checked: each.on });
    toggle.setAttribute("aria-label", `${each.name}: on`);
    toggle.addEventListener("change", () => {
      const skip = (state.values.skip || []).filter((name) => name !== each.name);
      set("skip", toggle.checked ? (skip.length ? skip : null) : [...skip, each.name]);
    });
    const details = made("details", {}, made("summary", {}, made("b", { textContent: each.name }), " ", made("span", { textContent: each.on ? each.method : "off" })));
    details.dataset.step = each.name;
    details.open = opened.has(each.name);
    details.append(made("p", { className: "help", textContent: declared.summary }));
    if (declared.methods.length > 1) {
      details.append(keyRow(`${each.name}.method`, "method", { enum: declared.methods.map((method) => method.name), text: chosen.summary }));
    } else details.append(made("p", { className: "help", textContent: chosen.summary }));
    for (const [name, schema] of Object.entries(chosen.parameters)) {
      const key = `${each.name}.${name}`;
      details.append(keyRow(key, name, schema, each.values[name]));
    }
    const item = made("div", { className: `step${each.on ? "" : " off"}${each.idle ? " idle" : ""}` }, toggle, details);
    item.dataset.step = each.name;
    return item;
  }));
  byId("step").replaceChildren(new Option("the picture", ""), ...facts.steps.filter((each) => each.here).map((each) => new Option(`after ${each.name}`, each.name)));
};

const showControls = (facts) => {
  const now = JSON.stringify(facts.steps.map((each) => [each.name, each.on, each.here, each.method]));
  if (now !== structure) {
    rows.length = 0;
    makeKeys(facts);
    makeStages(facts);
    byId("output").replaceChildren(...Object.entries(known.output).map(([name, schema]) => keyRow(`output.${name}`, name.replaceAll("_", " "), schema, schema.default)));
    structure = now;
  }
  if (facts.camera !== isoCamera) {
    const [low, high] = (known.cameras.find((each) => each.value === facts.camera) || { isos: [50, 102400] }).isos;
    const element = keyRow("iso", "ISO", { type: "number", minimum: low, maximum: high, log: true }, high);
    if (isoRow.firstChild) rows.splice(rows.indexOf(isoRow.firstChild), 1);
    isoRow.replaceChildren(element);
    isoCamera = facts.camera;
  }
  const { values } = state;
  const valueAt = (key) => key.split(".").reduce((table, name) => (table || {})[name], values);
  const resolved = { camera: facts.camera, iso: facts.iso, seed: facts.seed };
  for (const each of facts.steps) {
    resolved[`${each.name}.method`] = each.method;
    for (const [name, value] of Object.entries(each.values)) resolved[`${each.name}.${name}`] = value;
    const item = document.querySelector(`.step[data-step="${each.name}"]`);
    if (item) item.classList.toggle("idle", each.idle);
  }
  for (const [name, schema] of Object.entries(known.output)) resolved[`output.${name}`] = schema.default;
  for (const element of rows) {
    const { key } = element.dataset;
    const own = valueAt(key);
    const isSet = own !== undefined;
    const drawn = isSet && own !== null && typeof own === "object" && !Array.isArray(own);
    element.show(drawn || !isSet ? resolved[key] : own, isSet);
  }
  byId("noise-on").checked = !(values.skip || []).includes("noise");
  byId("step").value = state.step;
};

// What a page's settings are elsewhere.

const exported = async () => (await ask("export", { image: state.image, values: state.values })).json();

const save = async (text) => {
  const link = made("a", { href: URL.createObjectURL(new Blob([text], { type: "application/toml" })), download: known.saved });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
};

const say = (title, text, command) => {
  byId("say-title").textContent = title;
  byId("say-text").textContent = text;
  byId("say-command").textContent = command;
  byId("say").showModal();
};

const toClipboard = async (text) => {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return false; // the text is there to be copied by hand
  }
};

const tried = (work) => () => work().catch(complain);

byId("save").addEventListener("click", tried(async () => save((await exported()).config)));
byId("copy").addEventListener("click", tried(async () => {
  const { command } = await exported();
  const done = await toClipboard(command);
  say("Command line", done ? "It is copied, and makes this picture." : "It makes this picture.", command);
}));
byId("apply").addEventListener("click", tried(async () => {
  const { config, folder } = await exported();
  await save(config);
  say("Apply to a folder", `The settings are saved as ${known.saved}; beside it, this develops the folder:`, folder);
}));
byId("say-copy").addEventListener("click", () => toClipboard(byId("say-command").textContent));

byId("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const own = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  root.dataset.theme = (root.dataset.theme || own) === "dark" ? "light" : "dark";
});

byId("image").addEventListener("change", () => {
  state.image = Number(byId("image").value);
  changed();
});
byId("step").addEventListener("change", () => {
  state.step = byId("step").value;
  changed();
});
byId("compare").addEventListener("change", () => {
  if (byId("compare").value === "B" && !settingB) keepB();
  byId("split-label").hidden = !byId("compare").value;
  changed();
});
byId("split").addEventListener("input", draw);
const keepB = () => {
  settingB = copy(state.values);
  byId("swap-b").disabled = false;
};
byId("keep-b").addEventListener("click", () => {
  keepB();
  byId("compare").value = "B";
  byId("split-label").hidden = false;
  changed();
});
byId("swap-b").addEventListener("click", () => {
  const mine = copy(state.values);
  setValues(settingB);
  settingB = mine;
});
byId("zoom-in").addEventListener("click", () => zoomBy(1));
byId("zoom-out").addEventListener("click", () => zoomBy(-1));
byId("zoom-fit").addEventListener("click", fit);
byId("zoom-one").addEventListener("click", () => zoomTo(1));
byId("zoom-max").addEventListener("click", () => zoomTo(8));

const begin = async () => {
  known = await (await ask("start", {})).json();
  byId("device").textContent = known.device;
  byId("image").replaceChildren(...known.images.map((name, i) => new Option(name, i)));
  state.values = known.values;
  try {
    const held = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    if (held.values && held.image < known.images.length) Object.assign(state, held);
  } catch {
    // no settings in the address, so those of the start
  }
  byId("image").value = state.image;
  sizeCanvas();
  changed();
};
begin().catch(complain);
