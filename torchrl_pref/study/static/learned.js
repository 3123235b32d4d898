// What has been learned so far, and the answers that were given.

import { byId, button, drawn, element, short } from "./elements.js";
import { Player } from "./player.js";

let best = null; // the player of the trajectory that is thought best

/** Show it beside the question; undo is what is done to take an answer back. */
export function showLearned(state, undo) {
  const opened = remembered();
  best?.close();
  const { learned } = state;
  byId("learned").hidden = false;
  byId("learned").replaceChildren(
    folding("What has been learned so far", "weights", opened, ...weights(learned), ...sure(learned, state.phase === "question")),
    folding("The best, as far as is known", "best", opened, ...bestOf(learned)),
    folding(`Your answers (${state.answers.length})`, "answers", opened, answers(state, undo)),
  );
}

/** Which parts are open now; at first all where there is room beside the question. */
function remembered() {
  const parts = [...byId("learned").querySelectorAll("details")];
  if (parts.length > 0) return new Set(parts.filter((one) => one.open).map((one) => one.id));
  const wide = matchMedia("(min-width: 60rem)").matches;
  return new Set(wide ? ["part-weights", "part-best", "part-answers"] : []);
}

function folding(title, name, opened, ...children) {
  const id = `part-${name}`;
  const summary = element("summary", {}, element("h2", {}, title));
  return element("details", { id, open: opened.has(id) }, summary, ...children);
}

function weights({ names, mean, low, high }) {
  const reach = Math.max(...low.map(Math.abs), ...high.map(Math.abs), 1e-9);
  const rows = names.map((name, number) =>
    element("tr", {},
      element("th", { scope: "row" }, name),
      element("td", {}, interval(mean[number] / reach, low[number] / reach, high[number] / reach)),
      element("td", { className: "number" }, short(mean[number]),
        element("small", {}, ` ${short(low[number])} to ${short(high[number])}`)),
    ));
  const caption = element("caption", {}, "How much you like more of each, with where it lies with 90% probability.");
  return [element("table", {}, caption, element("tbody", {}, ...rows))];
}

/** A mean with its interval, from −1 to 1, as a drawing. */
function interval(mean, low, high) {
  const x = (value) => 50 + 47 * value;
  return drawn("svg", { viewBox: "0 0 100 16", class: "interval", "aria-hidden": "true" },
    drawn("line", { x1: 50, x2: 50, y1: 0, y2: 16, class: "zero" }),
    drawn("line", { x1: x(low), x2: x(high), y1: 8, y2: 8, class: "range" }),
    drawn("circle", { cx: x(mean), cy: 8, r: 3.5, class: "mean" }),
  );
}

function sure({ sureness, history, rationality, doubtful, ...learned }, asks) {
  const percent = Math.round(100 * sureness);
  const said = [
    element("p", { className: "sure" }, "How well you are known: ", element("strong", {}, `${percent} of 100`)),
    curve(history),
  ];
  if (asks) said.push(element("p", {}, worth(learned.expected_gain)));
  if (rationality !== null) said.push(element("p", {}, careful(rationality)));
  for (const one of doubtful) {
    said.push(element("p", { className: "doubtful" }, badly(one)));
  }
  return said;
}

function worth(gain) {
  if (gain === null) return "This question checks something else, and adds nothing.";
  return `Your next answer is expected to add ${short(100 * gain, 1)}.`;
}

function badly({ number, probability }) {
  const times = Math.round(100 * probability);
  const often = times < 1 ? "less than once" : times === 1 ? "once" : `${times} times`;
  return `Answer ${number} fits badly with the others: it would be given ${often} in 100. It may be a slip; it can be taken back below.`;
}

function careful({ median, low, high }) {
  return `Your care is put at ${short(median, 1)} (${short(low, 1)} to ${short(high, 1)}): the larger, the less chance is in your answers.`;
}

/** How well the person was known before the first answer, and after each. */
function curve(history) {
  const last = Math.max(1, history.length - 1);
  const points = history.map((value, number) => `${2 + (96 * number) / last},${38 - 36 * value}`);
  return drawn("svg", {
    viewBox: "0 0 100 40", class: "curve", role: "img",
    "aria-label": `How well you were known after each answer: ${history.map((value) => Math.round(100 * value)).join(", ")} of 100`,
  },
  drawn("line", { x1: 2, x2: 98, y1: 38, y2: 38, class: "zero" }),
  drawn("polyline", { points: points.join(" ") }),
  drawn("circle", { cx: points.at(-1).split(",")[0], cy: points.at(-1).split(",")[1], r: 1.8, class: "mean" }));
}

function bestOf(learned) {
  best = new Player([learned.best], [`The trajectory that is thought best: ${learned.best_label}`],
    () => [Math.min(300, innerWidth - 60), 220]);
  best.start(false).catch(() => best.controls.append("Its picture cannot be loaded."));
  return [
    element("p", {}, `This is ${learned.best_label}.`),
    element("div", { className: "best" }, ...best.canvases), quiet(best.controls),
  ];
}

/** Its keys are those of the question beside it. */
function quiet(controls) {
  controls.classList.add("quiet");
  controls.setAttribute("aria-label", "Watch the best");
  return controls;
}

function answers({ answers: given }, undo) {
  if (given.length === 0) return element("p", {}, "None yet.");
  const rows = given.map((one) =>
    element("li", { className: one.doubtful ? "doubtful" : "" },
      element("span", {}, `${one.number}. ${one.label}`),
      element("small", {}, one.doubtful ? "fits badly" : `${one.seconds} s`),
      button("Take back", null, () => undo(one.key), { "aria-label": `Take back answer ${one.number}` }),
    ));
  const label = "Your answers, the last one first";
  return element("ol", { className: "answers", tabIndex: 0, "aria-label": label }, ...rows.reverse());
}
