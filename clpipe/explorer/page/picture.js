"use strict";

// The image on the screen. The scale is device pixels per image pixel.

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
    label(context, "current", split - 8, "right");
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
  remember();
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
const POINTERS = new Map(); // two of them pinch

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
  if (drag && drag.kind === "box" && box) {
    openTab(byId("tab-noise"));
    measure();
  }
  drag = null;
};
canvas.addEventListener("pointerup", release);
canvas.addEventListener("pointercancel", release);
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoomBy(-event.deltaY, ...onCanvas(event));
}, { passive: false });

// Shortcuts of the whole page. Fields, lists, sliders, tabs and dialogs handle their own keys.
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || !picture) return;
  if (event.target.closest('input:not([type="checkbox"]), select, [role="tab"], dialog')) return;
  const by = 40 * density();
  const moves = { ArrowLeft: [by, 0], ArrowRight: [-by, 0], ArrowUp: [0, by], ArrowDown: [0, -by] };
  const others = { "+": () => zoomBy(1), "=": () => zoomBy(1), "-": () => zoomBy(-1), 0: fit, 1: () => zoomTo(1), 8: () => zoomTo(8), b: swapB, B: swapB, z: () => step(past, future), Z: () => step(future, past), "?": () => byId("keyboard").showModal() };
  if (moves[event.key]) {
    seen.x += moves[event.key][0];
    seen.y += moves[event.key][1];
    seen.fits = false;
    draw();
  } else if (others[event.key]) {
    others[event.key]();
  } else return;
  event.preventDefault();
});

new ResizeObserver(() => {
  if (seen.fits) fit();
  else {
    const { width, height } = canvas;
    sizeCanvas();
    seen.x += Math.round((canvas.width - width) / 2);
    seen.y += Math.round((canvas.height - height) / 2);
    draw();
  }
}).observe(canvas);

// Values under the pointer: 8-bit values as displayed, floats as computed.

let asked = null;

const readPixel = async ([x, y]) => {
  const { facts, pixels } = picture;
  if (!pixels || x < 0 || y < 0 || x >= facts.width || y >= facts.height) {
    byId("pixel").textContent = "\u00a0";
    return;
  }
  const place = `x ${x}, y ${y}: `;
  const eight = (shown) => [0, 1, 2].map((c) => shown[3 * (y * facts.width + x) + c]).join(", ");
  const compared = other && byId("compare").value && other.facts.width === facts.width && other.facts.height === facts.height
    ? ` (other: ${eight(other.pixels)})` : "";
  if (facts.kind === "display") {
    byId("pixel").textContent = `${place}R, G, B ${eight(pixels)}${compared}`;
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
  // The first and last bins do not scale the plot, because clipped pixels would dominate it.
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
  byId("histogram-text").textContent = `Share at 0: ${share(0)}; at 255: ${share(255)} (R, G, B). Bar heights are square roots of counts.`;
};

// The visible part of the image, and the factor by which it is reduced.
const window_ = () => {
  if (!picture) return { left: 0, top: 0, width: 1 << 20, height: 1 << 20, by: 4 };
  const { scale, x, y } = seen;
  const [left, top] = [Math.max(Math.floor(-x / scale), 0), Math.max(Math.floor(-y / scale), 0)];
  const [right, bottom] = [Math.ceil((canvas.width - x) / scale), Math.ceil((canvas.height - y) / scale)];
  return { left, top, width: Math.max(right - left, 0), height: Math.max(bottom - top, 0), by: Math.max(Math.round(1 / scale), 1) };
};
