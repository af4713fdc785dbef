"use strict";

// Noise measured in a rectangle.

const setBox = ([x0, y0], [x1, y1]) => {
  const limit = (value, most) => Math.min(Math.max(value, 0), most);
  const { width, height } = picture.facts;
  const [left, right] = [Math.min(x0, x1), Math.max(x0, x1)].map((x) => limit(x, width));
  const [top, bottom] = [Math.min(y0, y1), Math.max(y0, y1)].map((y) => limit(y, height));
  box = [left, top, Math.max(right - left, 2), Math.max(bottom - top, 2)];
  ["left", "top", "width", "height"].forEach((id, i) => { byId(id).value = box[i]; });
};

let measuring = false;
let measureAgain = false;
let measuredOf = "";

const measure = async () => {
  if (measuring) measureAgain = true;
  if (measuring || !picture) return;
  measuring = true;
  byId("measured").textContent = "Measuring …";
  const question = JSON.stringify([state, box]);
  try {
    const [left, top, width, height] = box;
    const answer = await (await ask("noise", { image: state.image, values: state.values, step: state.step, left, top, width, height })).json();
    const { channels, kind } = answer.report;
    const scale = kind === "display" ? 255 : 1;
    byId("noise-table").hidden = false;
    byId("noise-table").tBodies[0].replaceChildren(...Object.entries(channels).map(([name, channel]) => {
      const table = channel.autocorrelation;
      const middle = (table.length - 1) / 2;
      const figures = [channel.sigma * scale, table[middle][middle + 1], channel.energy_left_2x2, channel.excess_kurtosis];
      const cells = [name, ...figures.map((value) => value === null ? "-" : Number(value.toPrecision(4)))];
      return made("tr", {}, ...cells.map((text) => made("td", { textContent: text })));
    }));
    const drawn = new DOMParser().parseFromString(answer.svg, "image/svg+xml").documentElement;
    drawn.setAttribute("xmlns", "http://www.w3.org/2000/svg");
    byId("noise-plot").replaceChildren(document.importNode(drawn, true));
    measuredOf = question;
    byId("measured").textContent = `${(answer.report.share_used * 100).toFixed(0)} % of the pixels are used. Unit of sigma: ${scale === 255 ? "levels of 255" : answer.report.unit}.`;
  } catch (error) {
    byId("measured").textContent = error.message;
    measuredOf = "";
  } finally {
    measuring = false;
  }
  if (measureAgain) {
    measureAgain = false;
    await measure();
  } else noiseIsOld();
};

let remeasure = 0;
const noiseIsOld = () => {
  clearTimeout(remeasure);
  if (measuredOf && measuredOf !== JSON.stringify([state, box])) {
    byId("measured").textContent = "Measured with earlier settings.";
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
