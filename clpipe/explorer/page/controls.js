"use strict";

// Controls. Each is built once from the server's declarations. Later only its value changes.

const typeOf = (schema) => (schema.anyOf || [schema]).find((each) => each.type !== "null") || schema;

const limitsOf = (schema, value) => {
  const type = typeOf(schema);
  const low = type.minimum ?? type.exclusiveMinimum;
  const high = type.maximum ?? type.exclusiveMaximum;
  const size = Math.abs(Number(value)) || 0;
  const top = high === undefined || (size > 0 && high > 40 * size) ? (size ? 4 * size : 1) : high;
  // A slider over the whole allowed range would be too coarse.
  const to = size || low === undefined || low >= 0 ? top : Math.min(top, 5);
  const from = Math.max(low ?? -to, size || low >= 0 ? -Infinity : -to);
  const within = (to - from) / 400; // distance to an exclusive limit
  return {
    low,
    high,
    from: from === type.exclusiveMinimum ? from + within : from,
    to: to === type.exclusiveMaximum ? to - within : to,
  };
};

// The allowed range of a number in words, and the slider's range if it differs.
const between = (type) => {
  const { minimum, exclusiveMinimum, maximum, exclusiveMaximum } = type;
  const low = minimum !== undefined ? `from ${minimum}` : exclusiveMinimum !== undefined ? `above ${exclusiveMinimum}` : "";
  const high = maximum !== undefined ? `to ${maximum}` : exclusiveMaximum !== undefined ? `below ${exclusiveMaximum}` : "";
  const text = [low, high].filter(Boolean).join(" ");
  return text && `${text[0].toUpperCase()}${text.slice(1)}.`;
};

const figures = (value) => Number(Number(value).toPrecision(6));

const sliderText = (type, { from, to }) => {
  const [low, high] = [type.minimum ?? type.exclusiveMinimum, type.maximum ?? type.exclusiveMaximum];
  const near = (limit, end) => limit !== undefined && Math.abs(limit - end) <= (to - from) / 400;
  return near(low, from) && near(high, to) ? "" : `The slider covers ${figures(from)} to ${figures(to)}.`;
};

let count = 0;

// A row: the name, the inputs, and a button that resets the value to automatic.
const row = (key, name, schema, resolved) => {
  const type = typeOf(schema);
  const id = `set-${count += 1}`;
  const inputs = made("span", { className: "inputs" });
  const auto = made("button", { className: "auto", type: "button", textContent: "auto", title: "Reset to the automatic value" });
  auto.setAttribute("aria-label", `auto: ${name}`);
  const element = made("div", { className: "row" },
    made("div", { className: "line" }, made("label", { htmlFor: id, textContent: name + (schema.unit ? ` (${schema.unit})` : "") }), inputs, auto));
  const help = made("p", { className: "help", id: `${id}-help` });
  const explain = (sliding) => {
    help.textContent = [schema.text, between(type), sliding, schema.auto ? `Automatic: ${schema.auto}.` : ""].filter(Boolean).join(" ");
    element.title = help.textContent;
  };
  explain("");
  element.append(help);
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
    // Integers without both limits may have other constraints, for example odd numbers only.
    const slides = !schema.plain && limits.to > limits.from && !(whole && (limits.low === undefined || limits.high === undefined));
    if (slides) {
      const log = schema.log;
      const place = (value) => log ? Math.log2(value) : value;
      slider = made("input", { type: "range", step: whole && !log ? 1 : "any" });
      slider.setAttribute("aria-label", `${name}, slider`);
      let range = limits;
      slider.reach = (value, isSet) => {
        if (!log && !(isSet && value >= range.from && value <= range.to)) range = limitsOf(schema, value);
        explain(sliderText(type, range));
        slider.min = place(range.from);
        slider.max = place(range.to);
        slider.value = place(Number(value ?? 0));
      };
      slider.reach(resolved ?? schema.default ?? 0, false);
      const at = () => {
        const value = log ? 2 ** Number(slider.value) : Number(slider.value);
        const short = whole || (log && value > 20) ? Math.round(value) : Number(value.toPrecision(4));
        return Math.min(Math.max(short, range.from), range.to);
      };
      slider.addEventListener("input", () => { set(key, at(), true); field.value = at(); widen(); });
      slider.addEventListener("change", () => { lastKey = ""; });
      inputs.append(slider);
    }
  } else {
    field = made("input", { type: "text", placeholder: schema.placeholder || "" });
    field.addEventListener("change", () => set(key, parsed(field.value, type)));
    if (schema.suggested) {
      const list = made("datalist", { id: `${id}-list` }, ...schema.suggested.map((each) => new Option(each)));
      inputs.append(list);
      field.setAttribute("list", list.id);
    }
  }
  field.id = id;
  field.setAttribute("aria-describedby", help.id);
  inputs.append(field);
  auto.addEventListener("click", () => set(key, null));
  const widen = () => { field.style.width = `${Math.max(field.value.length, 4) + 4}ch`; };
  if (field.type === "number") field.addEventListener("input", widen);
  element.show = (value, isSet) => {
    element.classList.toggle("set", isSet);
    auto.hidden = !isSet;
    if (document.activeElement === field && field.type !== "checkbox" && field.tagName !== "SELECT") return;
    if (field.type === "checkbox") field.checked = Boolean(value);
    else if (field.type === "number") field.value = value === null || value === undefined ? "" : figures(value);
    else field.value = value === null || value === undefined ? "" : typeof value === "object" ? JSON.stringify(value) : value;
    if (field.type === "number") widen();
    if (slider && document.activeElement !== slider) slider.reach(value ?? 0, isSet);
  };
  return element;
};

const parsed = (text, type) => {
  if (text === "") return null;
  if (type.type !== "array" && !type.anyOf) return text;
  try {
    return JSON.parse(text);
  } catch {
    return text; // the server reports what is wrong with it
  }
};

let isoRow = null;
let isoCamera = "";
let structure = "";
const rows = []; // several rows may share a key

const keyRow = (key, name, schema, value) => {
  const element = row(key, name, schema, value);
  rows.push(element);
  return element;
};

const makeKeys = (facts) => {
  const camera = keyRow("camera", "Camera", { options: known.cameras });
  isoRow = made("div");
  const switchRow = made("div", { className: "row" });
  const noise = made("input", { type: "checkbox", id: "noise-on" });
  noise.addEventListener("change", () => {
    const skip = (state.values.skip || []).filter((name) => name !== "noise");
    set("skip", noise.checked ? (skip.length ? skip : null) : [...skip, "noise"]);
  });
  switchRow.append(made("div", { className: "line" }, made("label", { htmlFor: "noise-on", textContent: "Noise" }), noise));
  const exposing = facts.steps.find((each) => known.stages[each.stage].role === "EXPOSURE" && "ev" in each.values);
  const methods = exposing ? known.stages[exposing.stage].methods : [];
  const ev = methods.filter((method) => method.name === exposing.method).map((method) => method.parameters.ev);
  byId("keys").replaceChildren(camera, isoRow, switchRow,
    ...ev.map((schema) => keyRow(`${exposing.name}.ev`, "Exposure", schema, 0)));
  byId("more-keys").replaceChildren(...Object.entries(known.keys).map(([key, schema]) => keyRow(key, key.replaceAll("_", " "), schema, 0)));
  isoCamera = "";
};

const makeStages = (facts) => {
  const opened = new Set([...document.querySelectorAll("#stages details[open]")].map((each) => each.dataset.step));
  // Raws skip the first stages, and chains without noise have no noise stages.
  const items = facts.steps.filter((each) => each.here || !each.on).map((each) => {
    const declared = known.stages[each.stage];
    const chosen = declared.methods.find((method) => method.name === each.method) || declared.methods[0];
    const toggle = made("input", { type: "checkbox", checked: each.on });
    // Settings that the image file carries cannot be reverted here.
    toggle.disabled = !each.on && !(state.values.skip || []).includes(each.name);
    toggle.addEventListener("change", () => {
      const skip = (state.values.skip || []).filter((name) => name !== each.name);
      set("skip", toggle.checked ? (skip.length ? skip : null) : [...skip, each.name]);
    });
    const details = made("details", {}, made("summary", {}, made("b", { textContent: each.name }), " ", made("span")));
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
    details.addEventListener("toggle", () => placeStep(item));
    return [each.group, item];
  });
  const names = [...new Set(items.map(([group]) => group))];
  byId("stages").replaceChildren(...names.map((name) => stageGroup(name, items.filter(([group]) => group === name).map(([, item]) => item))));
  byId("step").replaceChildren(new Option("final image", ""), ...facts.steps.filter((each) => each.here).map((each) => new Option(`after ${each.name}`, each.name)));
};

// A group of stages: a heading, the active stages, and "inactive", which is collapsed.
const stageGroup = (name, items) => {
  const inactive = made("details", { className: "inactive" }, made("summary"), made("div"));
  inactive.open = Boolean(document.querySelector(`[data-group="${name}"] .inactive[open]`));
  const group = made("section", {}, made("h2", { textContent: name }), made("div", { className: "active" }), inactive);
  group.dataset.group = name;
  group.setAttribute("aria-label", name);
  for (const item of items) item.group = { inactive, items, active: group.children[1] };
  items.forEach(placeStep);
  return group;
};

// Move a stage to the active or the inactive ones, unless it is open. Stages that the user skips
// count as active, so that they stay in view.
const placeStep = (item) => {
  const { inactive, items, active } = item.group;
  if (item.parentElement && item.querySelector("details").open) return;
  const isSkipped = (state.values.skip || []).includes(item.dataset.step);
  const list = item.matches(".idle") && !isSkipped ? inactive.lastChild : active;
  if (item.parentElement !== list) {
    const later = items.slice(items.indexOf(item) + 1);
    list.insertBefore(item, later.find((each) => each.parentElement === list) || null);
  }
  const count = inactive.lastChild.childElementCount;
  inactive.hidden = !count;
  inactive.firstChild.textContent = `inactive (${count})`;
};

// Show the state of a stage. The checkbox of an inactive stage is indeterminate.
const showStep = (item, { name, on, idle, method }) => {
  const toggle = item.querySelector("input");
  const nothing = on && idle;
  item.classList.toggle("idle", idle);
  toggle.indeterminate = nothing;
  toggle.setAttribute("aria-label", `${name}: on${nothing ? ", inactive" : ""}`);
  item.querySelector("summary span").textContent = !on ? "off" : !nothing ? method : method === "none" ? "inactive" : `inactive (${method})`;
  placeStep(item);
};

// The facts with the requested methods and switches, so that rejected settings can be corrected.
const asAsked = (facts) => {
  const { values } = state;
  const steps = facts.steps.map((each) => {
    const method = (values[each.name] || {}).method;
    const on = !(values.skip || []).includes(each.name);
    if (typeof method !== "string" || method === each.method) return { ...each, on };
    return { ...each, on, method, values: {} };
  });
  return { ...facts, steps };
};

const tableKeys = () => Object.entries(known.tables).flatMap(([table, keys]) => Object.entries(keys).map(([name, schema]) => [`${table}.${name}`, name, schema]));

const showControls = (facts) => {
  const now = JSON.stringify(facts.steps.map((each) => [each.name, each.on, each.here, each.method]));
  if (now !== structure) {
    rows.length = 0;
    makeKeys(facts);
    makeStages(facts);
    byId("output").replaceChildren(...tableKeys().map(([key, name, schema]) => keyRow(key, name.replaceAll("_", " "), schema, schema.default)));
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
    if (item) showStep(item, each);
  }
  for (const [key, , schema] of tableKeys()) resolved[key] = schema.default;
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
