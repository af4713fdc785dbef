"use strict";

// What the pages of reports and of the explorer share. It runs before their own scripts.

const byId = (id) => document.getElementById(id);

const made = (tag, properties = {}, ...children) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
};

byId("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const own = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  root.dataset.theme = (root.dataset.theme || own) === "dark" ? "light" : "dark";
});
