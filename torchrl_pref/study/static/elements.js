// Elements of the page. Texts are set as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";

/** The element of an id. */
export const byId = (id) => document.getElementById(id);

/** A new element: its properties, then what is in it. Properties with a dash are attributes. */
export function element(tag, properties = {}, ...children) {
  return filled(document.createElement(tag), properties, children);
}

/** The same of a drawing, where all properties are attributes. */
export function drawn(tag, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

function filled(made, properties, children) {
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-") || name === "role") made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children.filter((child) => child !== null));
  return made;
}

/** A button that says by which key it is pressed as well. */
export function button(label, key, onclick, properties = {}) {
  const shown = key === null ? null : element("kbd", {}, nameOf(key));
  const keys = key === null ? {} : { "aria-keyshortcuts": nameOf(key) };
  return element("button", { type: "button", onclick, ...keys, ...properties }, label, shown);
}

function nameOf(key) {
  if (key === " ") return "Space";
  return key.length === 1 ? key.toUpperCase() : key;
}

/** A number to two digits, with a true minus. */
export const short = (value, digits = 2) =>
  value.toFixed(digits).replace("-", "−").replace(/^−(0\.?0*)$/, "$1");
