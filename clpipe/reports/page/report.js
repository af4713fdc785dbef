const held = (id) => (byId(id) ? JSON.parse(byId(id).textContent) : []);

// The contact sheet: filters, and pages of the images that pass them.

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

const listItem = (entry) => {
  const picture = entry.image
    ? made("img", { src: entry.image, alt: entry.name })
    : made("span", { className: "none", textContent: "no image" });
  const about = [`ISO ${entry.iso}, ${(entry.clipped * 100).toFixed(1)} % clipped`, ...entry.odd];
  return made("li", { className: entry.odd.length ? "odd" : "" }, picture,
    made("span", { className: "name", textContent: entry.name }),
    made("span", { className: "about", textContent: about.join("; ") }));
};

const drawSheet = () => {
  const left = filtered();
  const pages = Math.max(Math.ceil(left.length / PAGE), 1);
  page = Math.min(page, pages - 1);
  byId("sheet-list").replaceChildren(...left.slice(page * PAGE, (page + 1) * PAGE).map(listItem));
  byId("sheet-count").textContent = `${left.length} of ${entries.length} images`;
  byId("page-number").textContent = `Page ${page + 1} of ${pages}`;
  byId("page-back").disabled = page === 0;
  byId("page-next").disabled = page === pages - 1;
};

const turn = (by) => () => { page += by; drawSheet(); };
for (const id of FILTERS) byId(id).addEventListener("input", () => { page = 0; drawSheet(); });
byId("page-back").addEventListener("click", turn(-1));
byId("page-next").addEventListener("click", turn(1));
drawSheet();

// The comparison: a split over two images, and crops of one region of both.

const SMALLEST = 640; // px on the screen; smaller images are enlarged by an integer factor
const large = held("look-data");
if (large.length) {
  const [slider, split, marks, under, over, loupes, image, left, right, place] = [
    "slider", "look-split", "look-marks", "look-under", "look-over", "loupes",
    "look-image", "look-left", "look-right", "look-place"].map(byId);
  const canvases = [...loupes.querySelectorAll("canvas")];
  const closest = canvases.at(-1);
  const here = made("span", { className: "here" });
  const sides = { left: { select: left, picture: over }, right: { select: right, picture: under } };
  const shown = () => large[image.value];
  let at = [0, 0]; // centre of the crops, in image px

  const within = (value, least, most) => Math.max(least, Math.min(value, most));
  const middle = ({ left, top, width, height }) => [left + width / 2, top + height / 2];

  const outline = (mark, box) => {
    const { width, height } = shown();
    const percents = { left: box.left / width, width: box.width / width, top: box.top / height, height: box.height / height };
    for (const [name, share] of Object.entries(percents)) mark.style[name] = `${100 * share}%`;
    return mark;
  };

  // The regions stored at full resolution: the whole image, or its crops.
  const parts = () => {
    const { by, width, height, places } = shown();
    return by > 1 ? places : [{ left: 0, top: 0, width, height }];
  };

  // The middle of a crop at 400 % that is within a part and closest to a place.
  const inside = ({ left, top, width, height }, [x, y]) => {
    const zoom = 2 * closest.dataset.zoom;
    const [wide, high] = [Math.min(closest.width / zoom, width / 2), Math.min(closest.height / zoom, height / 2)];
    return [within(x, left + wide, left + width - wide), within(y, top + high, top + height - high)];
  };

  const nearest = ([x, y]) => {
    const far = ({ left, top, width, height }) =>
      Math.hypot(within(x, left, left + width) - x, within(y, top, top + height) - y);
    const number = parts().reduce((a, b, i, all) => (far(b) < far(all[a]) ? i : a), 0);
    const part = parts()[number];
    return { number, part, point: inside(part, [x, y]) };
  };

  // The top left corner of the area that a canvas shows, in px of its region.
  const corner = (canvas, part, point) => [
    [point[0] - part.left, canvas.width, part.width], [point[1] - part.top, canvas.height, part.height],
  ].map(([value, size, most]) => {
    const wide = size / canvas.dataset.zoom;
    return most > wide ? Math.round(within(value - wide / 2, 0, most - wide)) : (most - wide) / 2;
  });

  const drawLoupes = () => {
    const { number, part, point } = nearest(at);
    for (const canvas of canvases) {
      const { side, zoom } = canvas.dataset;
      const { picture, crops } = sides[side];
      const source = shown().by > 1 ? crops[number] : picture;
      const context = canvas.getContext("2d");
      context.imageSmoothingEnabled = false;
      context.clearRect(0, 0, canvas.width, canvas.height);
      if (!source || !source.complete || !source.naturalWidth) continue;
      const [x, y] = corner(canvas, part, point);
      context.drawImage(source, -x * zoom, -y * zoom, part.width * zoom, part.height * zoom);
    }
    const [x, y] = corner(closest, part, point);
    const [width, height] = [closest.width / closest.dataset.zoom, closest.height / closest.dataset.zoom];
    outline(here, { left: part.left + x, top: part.top + y, width, height });
  };

  const moveTo = (point) => {
    at = nearest(point).point;
    drawLoupes();
  };

  const drawSplit = () => {
    slider.style.setProperty("--split", `${split.value}%`);
    split.setAttribute("aria-valuetext", `${Math.round(split.value)} percent`);
  };

  const show = () => {
    const { name, views } = shown();
    for (const side of Object.values(sides)) {
      const view = views[side.select.value];
      side.picture.src = view.image;
      side.picture.alt = `${name}: ${view.label}`;
      side.crops = view.crops.map((address) => {
        const crop = new Image();
        crop.addEventListener("load", drawLoupes);
        crop.src = address;
        return crop;
      });
    }
  };

  const choose = () => {
    const { name, width, by, places, views } = shown();
    [left, right].forEach((select, number) => {
      select.replaceChildren(...views.map((view, i) => new Option(view.label, i)));
      select.value = Math.min(number, views.length - 1);
    });
    place.replaceChildren(...places.map((each, i) => new Option(each.name, i)));
    const wide = Math.ceil(width / by);
    const times = Math.max(Math.floor(SMALLEST / wide), 1);
    slider.style.width = `${times * wide}px`;
    slider.classList.toggle("enlarged", times > 1);
    marks.replaceChildren(here, ...(by > 1 ? places : []).map((each) => outline(made("span"), each)));
    for (const facts of document.querySelectorAll(".look-facts")) {
      facts.hidden = facts.dataset.number !== image.value;
    }
    for (const strip of document.querySelectorAll(".strip")) {
      strip.hidden = strip.dataset.name !== name;
    }
    show();
    moveTo(middle(places[0]));
  };

  const follow = (event) => {
    const box = slider.getBoundingClientRect();
    const { width, height } = shown();
    moveTo([((event.clientX - box.left) / box.width) * width, ((event.clientY - box.top) / box.height) * height]);
  };

  const STEPS = { ArrowLeft: [-8, 0], ArrowRight: [8, 0], ArrowUp: [0, -8], ArrowDown: [0, 8] };
  const moveBy = (x, y) => {
    const { part, point } = nearest(at);
    at = inside(part, [point[0] + x, point[1] + y]);
    drawLoupes();
  };

  split.addEventListener("input", drawSplit);
  slider.addEventListener("pointermove", follow);
  slider.addEventListener("pointerdown", follow);
  loupes.addEventListener("keydown", (event) => {
    if (!STEPS[event.key]) return;
    event.preventDefault();
    moveBy(...STEPS[event.key]);
  });
  for (const canvas of canvases) {
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      moveBy(-event.movementX / canvas.dataset.zoom, -event.movementY / canvas.dataset.zoom);
    });
  }
  new ResizeObserver(() => {
    for (const canvas of canvases) [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight];
    drawLoupes();
  }).observe(loupes);
  for (const picture of [over, under]) picture.addEventListener("load", drawLoupes);
  for (const select of [left, right]) select.addEventListener("input", show);
  image.addEventListener("input", choose);
  place.addEventListener("input", () => moveTo(middle(shown().places[place.value])));
  drawSplit();
  choose();
}
