"use strict";

// The page's state is a configuration, as nested values. The server is stateless: it develops each
// request, so several pages do not affect each other.

const copy = (value) => JSON.parse(JSON.stringify(value));
const same = (one, two) => JSON.stringify(one) === JSON.stringify(two);

const state = { image: 0, values: {}, step: "" };
let known; // the server's declarations
let past = [];
let future = [];
let settingB = null;
let picture = null; // facts, pixels, canvas; and the visible part, until they are loaded
let other = null; // the image to compare with, and its request

// Requests.

const ask = async (name, question) => {
  const body = JSON.stringify(question);
  let response;
  try {
    response = await fetch(name, { method: "POST", body });
  } catch {
    throw Object.assign(new Error("clpipe explore has ended. Start it again."), { key: "" });
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

const whole = async (facts) => {
  const { pixels, canvas: all } = await pictured("pixels", { number: facts.number });
  return { facts, pixels, canvas: all };
};

const questionOf = (values, truth) => ({ image: state.image, values, step: state.step, truth });
