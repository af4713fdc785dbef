"use strict";

// Development: one request at a time, then the latest settings.

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
    const isNew = !before || before.width !== facts.width || before.height !== facts.height || picture.image !== question.image;
    if (isNew) {
      picture = { facts, pixels: null, canvas: null, patch: first, image: question.image };
      fit();
    } else {
      picture = { ...picture, facts, patch: first };
      draw();
    }
    developedOf = question.values;
    complain(null);
    tell(facts, performance.now() - start);
    showControls(facts);
    remember(of);
    if (!again) {
      picture = { ...(await whole(facts)), image: question.image };
      draw();
      drawHistogram();
    }
    if (!again) await refreshOther();
    noiseIsOld();
  } catch (error) {
    complain(error);
    if (picture) showControls(asAsked(picture.facts));
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
    other = null;
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

let developedOf = null; // the last valid values

const complain = (error) => {
  if (error && picture && picture.image !== state.image) { // it shows another image
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
  const device = facts.launches.reduce((sum, launch) => sum + launch.ms, 0);
  byId("status").textContent =
    `${facts.width} x ${facts.height} px; ${shown.toFixed(0)} ms in total, ` +
    `development ${(facts.seconds * 1e3).toFixed(0)} ms, device ${device.toFixed(1)} ms` +
    (facts.clipped ? `; ${(facts.clipped * 100).toFixed(2)} % clipped` : "") +
    Object.entries(facts.estimates).map(([step, found]) =>
      `; ${step}: ${Object.entries(found).map(([name, value]) => `${name} ${value.toPrecision(4)}`).join(", ")}`).join("") +
    facts.warnings.map((warning) => `; warning: ${warning}`).join("");
  byId("launches").replaceChildren(...facts.launches.map((launch) => {
    const time = made("td", { textContent: launch.ms.toFixed(2) });
    return made("tr", {}, made("td", { textContent: launch.name }), time);
  }));
};

// Settings with undo and redo.

let lastKey = "";

// Undo restores the values and, after a swap, also settings B.
const setValues = (values, key = "", swapped = null) => {
  if (same(values, state.values)) return;
  if ((values.skip || []).includes(state.step)) state.step = "";
  if (!key || key !== lastKey) past.push({ values: state.values, b: swapped });
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
  const { values, b } = from.pop();
  to.push({ values: state.values, b: b && settingB });
  state.values = values;
  settingB = b || settingB;
  lastKey = "";
  changed();
};

byId("back").addEventListener("click", () => setValues(developedOf));

// The keys [ and ] select the previous and the next stage.
document.addEventListener("keydown", (event) => {
  const way = { "[": -1, "]": 1 }[event.key];
  if (!way || event.target.matches('input[type="text"], input[type="number"]')) return;
  const { options } = byId("step");
  const order = [...[...options].slice(1), options[0]]; // the final image is last
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

// The fragment of the address stores the view: the settings developed last, zoom, comparison and
// rectangle.

let remembered = "";
let remembering = 0;
const fragment = () => `#${encodeURIComponent(JSON.stringify({ ...JSON.parse(remembered), view: viewed() }))}`;
const remember = (of = remembered) => {
  remembered = of;
  clearTimeout(remembering);
  if (of) remembering = setTimeout(() => history.replaceState(null, "", fragment()), 300);
};

const viewed = () => ({
  compare: byId("compare").value,
  split: Number(byId("split").value),
  b: settingB,
  box,
  at: seen.fits ? null : [seen.scale, (canvas.width / 2 - seen.x) / seen.scale, (canvas.height / 2 - seen.y) / seen.scale],
});

const areNumbers = (values, length) => Array.isArray(values) && values.length === length && values.every(Number.isFinite);

// Restore a view from a fragment. Damaged values are ignored.
const lookAs = ({ compare, split, b, box: rectangle, at }) => {
  if (b && typeof b === "object") keepB(b);
  if ([...byId("compare").options].some(({ value }) => value === compare && (value !== "B" || settingB))) compareWith(compare);
  if (Number.isFinite(split)) byId("split").value = split;
  if (areNumbers(rectangle, 4)) {
    const [left, top, width, height] = rectangle;
    setBox([left, top], [left + width, top + height]);
  }
  if (areNumbers(at, 3) && at[0] > 0) {
    const [scale, x, y] = at;
    [seen.x, seen.y] = [canvas.width / 2 - x * seen.scale, canvas.height / 2 - y * seen.scale];
    zoomTo(scale);
  }
};

// Export of the settings.

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
    return false; // the dialog shows the text to copy by hand
  }
};

const tried = (work) => () => work().catch(complain);

byId("save").addEventListener("click", tried(async () => save((await exported()).config)));
byId("copy").addEventListener("click", tried(async () => {
  const { command } = await exported();
  const done = await toClipboard(command);
  say("Command line", `${done ? "Copied. " : ""}This command produces this image.`, command);
}));
byId("apply").addEventListener("click", tried(async () => {
  const { config, folder } = await exported();
  await save(config);
  say("Apply to a folder", `The settings are saved as ${known.saved}. Run this command next to that file to develop the folder:`, folder);
}));
byId("link").addEventListener("click", tried(async () => {
  if (!remembered) return;
  const address = location.href.split("#")[0] + fragment();
  const done = await toClipboard(address);
  say("Link", `${done ? "Copied. " : ""}The link works while this program runs. The part after “#” contains the settings.`, address);
}));
byId("say-copy").addEventListener("click", () => toClipboard(byId("say-command").textContent));

byId("image").addEventListener("change", () => {
  state.image = Number(byId("image").value);
  changed();
});
byId("step").addEventListener("change", () => {
  state.step = byId("step").value;
  changed();
});
byId("compare").addEventListener("change", () => {
  if (byId("compare").value === "B" && !settingB) keepB(state.values);
  compareWith(byId("compare").value);
  changed();
});
byId("split").addEventListener("input", draw);
const keepB = (values) => {
  settingB = copy(values);
  byId("swap-b").disabled = false;
};
const compareWith = (kind) => {
  byId("compare").value = kind;
  byId("split").hidden = !kind;
};
byId("keep-b").addEventListener("click", () => {
  keepB(state.values);
  compareWith("B");
  changed();
});
byId("help").addEventListener("click", () => byId("keyboard").showModal());
const swapB = () => {
  if (!settingB || same(settingB, state.values)) return;
  const [mine, theirs] = [copy(state.values), settingB];
  settingB = mine;
  setValues(theirs, "", theirs);
};
byId("swap-b").addEventListener("click", swapB);
byId("zoom-in").addEventListener("click", () => zoomBy(1));
byId("zoom-out").addEventListener("click", () => zoomBy(-1));
byId("zoom-fit").addEventListener("click", fit);
byId("zoom-one").addEventListener("click", () => zoomTo(1));
byId("zoom-max").addEventListener("click", () => zoomTo(8));

// Tabs.

const tabs = [...document.querySelectorAll('[role="tab"]')];
const openTab = (tab) => {
  for (const each of tabs) {
    const isOpen = each === tab;
    each.setAttribute("aria-selected", isOpen);
    each.tabIndex = isOpen ? 0 : -1;
    byId(each.getAttribute("aria-controls")).hidden = !isOpen;
  }
};
tabs.forEach((tab, i) => {
  tab.addEventListener("click", () => openTab(tab));
  tab.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    const next = tabs.at((i + by) % tabs.length);
    openTab(next);
    next.focus();
  });
});

const begin = async () => {
  known = await (await ask("start", {})).json();
  byId("device").textContent = known.device;
  byId("image").replaceChildren(...known.images.map((name, i) => new Option(name, i)));
  state.values = known.values;
  let view = null;
  try {
    const { image, values, step: seenStep, view: held } = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    if (values && image < known.images.length) {
      Object.assign(state, { image, values, step: seenStep || "" });
      view = held;
    }
  } catch {
    // the address has no settings: keep the initial ones
  }
  byId("image").value = state.image;
  sizeCanvas();
  document.body.dataset.settled = "false";
  await refresh();
  if (developedOf && view) {
    lookAs(view);
    await refresh();
  }
  if (!developedOf && location.hash) { // the stored settings do not fit these images
    Object.assign(state, { image: 0, values: known.values, step: "" });
    byId("image").value = 0;
    changed();
  }
};
window.addEventListener("hashchange", () => location.reload());
begin().catch(complain);
