"use strict";

const byId = (id) => document.getElementById(id);
const held = (id) => (byId(id) ? JSON.parse(byId(id).textContent) : []);

byId("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const own = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  root.dataset.theme = (root.dataset.theme || own) === "dark" ? "light" : "dark";
});

// The contact sheet: filters, and pages of what they leave.

const PAGE = 42;
const FILTERS = ["filter-iso", "filter-camera", "filter-clipped", "filter-odd", "filter-name"];
const entries = held("sheet-data");
let page = 0;

const fill = (select, values) => values.forEach((value) => select.add(new Option(value, value)));
fill(byId("filter-iso"), [...new Set(entries.map((entry) => entry.iso))].sort((a, b) => a - b));
fill(byId("filter-camera"), [...new Set(entries.map((entry) => entry.camera))].sort());

const filtered = () => {
  const [iso, camera, clipped, , name] = FILTERS.map((id) => byId(id).value);
  const oddOnly = byId("filter-odd").checked;
  return entries.filter((entry) =>
    (!iso || String(entry.iso) === iso) &&
    (!camera || entry.camera === camera) &&
    entry.clipped * 100 >= Number(clipped) &&
    (!oddOnly || entry.odd.length > 0) &&
    entry.name.toLowerCase().includes(name.toLowerCase()));
};

const made = (tag, className, text) => {
  const element = document.createElement(tag);
  element.className = className;
  element.textContent = text;
  return element;
};

const listItem = (entry) => {
  const item = made("li", entry.odd.length ? "odd" : "", "");
  const picture = entry.image ? made("img", "", "") : made("span", "none", "no picture");
  if (entry.image) {
    picture.src = entry.image;
    picture.alt = entry.name;
  }
  const about = [`ISO ${entry.iso}, ${(entry.clipped * 100).toFixed(1)} % clipped`, ...entry.odd];
  item.append(picture, made("span", "name", entry.name), made("span", "about", about.join("; ")));
  return item;
};

const drawSheet = () => {
  const left = filtered();
  const pages = Math.max(Math.ceil(left.length / PAGE), 1);
  page = Math.min(page, pages - 1);
  byId("sheet-list").replaceChildren(...left.slice(page * PAGE, (page + 1) * PAGE).map(listItem));
  byId("sheet-count").textContent = `${left.length} of ${entries.length} pictures`;
  byId("page-number").textContent = `page ${page + 1} of ${pages}`;
  byId("page-back").disabled = page === 0;
  byId("page-next").disabled = page === pages - 1;
};

const turn = (by) => () => { page += by; drawSheet(); };
for (const id of FILTERS) byId(id).addEventListener("input", () => { page = 0; drawSheet(); });
byId("page-back").addEventListener("click", turn(-1));
byId("page-next").addEventListener("click", turn(1));
drawSheet();

// Two pictures of an image: a slider over both, and crops around the pointer.

const large = held("look-data");
if (large.length) {
  const [slider, split, under, over, image, left, right] =
    ["slider", "look-split", "look-under", "look-over", "look-image", "look-left", "look-right"].map(byId);
  const sides = { left: over, right: under };
  let place = [0.5, 0.5];

  const drawSplit = () => {
    slider.style.setProperty("--split", `${split.value}%`);
    split.setAttribute("aria-valuetext", `${Math.round(split.value)} percent`);
  };

  const drawLoupes = () => {
    for (const [side, picture] of Object.entries(sides)) {
      for (const zoom of [1, 4]) {
        const canvas = byId(`loupe-${side}-${zoom}`);
        const context = canvas.getContext("2d");
        const [width, height] = [canvas.width / zoom, canvas.height / zoom];
        const x = Math.round(place[0] * picture.naturalWidth - width / 2);
        const y = Math.round(place[1] * picture.naturalHeight - height / 2);
        context.imageSmoothingEnabled = false;
        context.clearRect(0, 0, canvas.width, canvas.height);
        if (picture.complete && picture.naturalWidth) {
          context.drawImage(picture, x, y, width, height, 0, 0, canvas.width, canvas.height);
        }
      }
    }
  };

  const show = () => {
    const { name, views } = large[image.value];
    for (const [picture, select] of [[over, left], [under, right]]) {
      picture.src = views[select.value].image;
      picture.alt = `${name}: ${views[select.value].label}`;
    }
  };

  const choose = () => {
    const one = large[image.value];
    [left, right].forEach((select, number) => {
      select.replaceChildren(...one.views.map((view, i) => new Option(view.label, i)));
      select.value = Math.min(number, one.views.length - 1);
    });
    slider.style.width = `${one.width}px`;
    for (const facts of document.querySelectorAll(".look-facts")) {
      facts.hidden = facts.dataset.number !== image.value;
    }
    for (const strip of document.querySelectorAll(".strip")) {
      strip.hidden = strip.dataset.name !== one.name;
    }
    show();
  };

  split.addEventListener("input", drawSplit);
  slider.addEventListener("pointermove", (event) => {
    const box = slider.getBoundingClientRect();
    place = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    drawLoupes();
  });
  for (const picture of [over, under]) picture.addEventListener("load", drawLoupes);
  for (const select of [left, right]) select.addEventListener("input", show);
  image.addEventListener("input", choose);
  drawSplit();
  choose();
}
