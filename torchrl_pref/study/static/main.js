// The page of a study: begin, a question after the other, the end. docs/study.md lists what the
// server is asked. Whatever is shown comes from the server; the page keeps the person's code and an
// answer that is on its way, so that a reload loses neither.

import { Answering, letterOf } from "./answering.js";
import { byId, button, element } from "./elements.js";
import { showLearned } from "./learned.js";
import { Player } from "./player.js";
import { get, post } from "./server.js";

const RETRY = 2000; // milliseconds
const NO_KEY = 401; // the status where the link lacks its key: with the right link it goes on
const kept = sessionStorage; // of this tab: who answers in another one may be somebody else

let study = null;
let state = null;
let player = null;
let answering = null;
let since = 0; // when the question was shown

/** Do something on the server, however often that has to be tried. */
async function surely(ask) {
  for (;;) {
    try {
      const reply = await ask();
      if (reply.status < 500) {
        byId("problem").hidden = true;
        return reply;
      }
      await problem(reply.content.error);
    } catch {
      await problem("The study cannot be reached. Nothing that you said is lost: it is tried again every two seconds.");
    }
  }
}

/** Say what is wrong, until it is time to try again. */
function problem(sentence) {
  const box = byId("problem");
  if (box.firstChild?.textContent !== sentence) {
    box.replaceChildren(element("span", {}, sentence), button("Try now", null, () => {}));
  }
  box.hidden = false;
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, RETRY);
    box.querySelector("button").onclick = () => {
      clearTimeout(timer);
      resolve();
    };
  });
}

/** Something that stays until the person does something else. */
function notice(sentence) {
  byId("problem").replaceChildren(element("span", {}, sentence));
  byId("problem").hidden = false;
}

async function begin() {
  const { status, content } = await surely(() => get("/api/study"));
  if (status !== 200) {
    byId("main").replaceChildren(element("h2", {}, "This study cannot be opened"));
    notice(content.error);
    return;
  }
  study = content;
  document.title = study.title;
  byId("title").textContent = study.title;
  const code = kept.getItem("code");
  if (code === null) welcome();
  else await resume(code);
}

/** Go on after a reload: first with the answer that was on its way. */
async function resume(code) {
  const sent = kept.getItem("answer");
  if (sent !== null) {
    const pending = JSON.parse(sent);
    const { status } = await surely(() => post("/api/answer", pending));
    if (status !== NO_KEY) kept.removeItem("answer");
  }
  await join(code, false);
}

async function join(code, consent) {
  const { status, content } = await surely(() => post("/api/join", { code, consent }));
  if (status === 200) {
    kept.setItem("code", code);
    show(content);
  } else {
    kept.removeItem("code");
    welcome();
    notice(content.error);
  }
}

const BLOCKS = {
  heading: (block) => element("h3", {}, block.text),
  paragraph: (block) => element("p", {}, block.text),
  list: (block) => element("ul", {}, ...block.items.map((text) => element("li", {}, text))),
};

const ABOUT = (count) =>
  `There are at most ${count} questions about what you like. There is no right answer. Every answer is saved at once; you can take any of them back, and stop whenever you like.`;

function welcome() {
  leave();
  state = null;
  byId("progress").hidden = byId("who").hidden = byId("learned").hidden = true;
  const invited = new URLSearchParams(location.hash.slice(1)).get("code") ?? "";
  const code = element("input", {
    id: "code", required: true, maxLength: 32, pattern: "[A-Za-z0-9_\\-]+", autocomplete: "off",
    spellcheck: false, value: invited, "aria-describedby": "code-help",
  });
  const help = study.participants === "named"
    ? "The one that you were given."
    : "One that you make up, or were given: letters, digits, - and _. Your name is not asked for. With the same code you can go on later, on any browser.";
  const consent = !study.consent ? null : element("p", {},
    element("label", { className: "consent" }, element("input", { type: "checkbox", required: true }),
      "I have read this, and I agree to take part."));
  const form = element("form", { onsubmit: (event) => {
    event.preventDefault();
    join(code.value, study.consent); // which the form asks for
  } },
  element("label", { htmlFor: "code" }, "Your code"), code,
  element("small", { id: "code-help" }, help), consent,
  element("button", { type: "submit", className: "main" }, "Begin"));
  byId("main").replaceChildren(element("section", { className: "welcome" },
    element("h2", {}, "Welcome"), element("p", {}, ABOUT(study.questions)), ...study.instructions.map((block) => BLOCKS[block.kind](block)), form));
  code.focus();
}

/** Put an end to what is shown. */
function leave() {
  player?.close();
  player = answering = null;
}

function show(next) {
  state = next;
  leave();
  byId("who").replaceChildren(`You are ${state.code}. `, button("Somebody else", null, () => {
    if (answering?.busy) return; // an answer is on its way
    kept.clear();
    byId("problem").hidden = true;
    welcome();
  }));
  byId("who").hidden = byId("progress").hidden = false;
  byId("bar").max = state.budget;
  byId("bar").value = state.answered;
  if (state.phase === "end") showEnd();
  else showQuestion(state.question);
  showLearned(state, undo);
}

/** Room of an option in pixels, so that all of a question is seen at once. */
function room(count) {
  const across = byId("main").clientWidth;
  const each = Math.min(count, across < 600 ? 2 : 4);
  const rows = Math.ceil(count / each);
  const high = innerHeight - (across < 600 ? 510 : 425);
  return [(across - 34 - 16 * (each - 1)) / each - 24, Math.max(rows > 1 ? 130 : 200, high / rows)];
}

function showQuestion(question) {
  byId("count").textContent = `Question ${question.number} of at most ${state.budget}`;
  answering = new Answering(question, answer);
  const names = question.options.map((_, place) => `Option ${letterOf(place)}`);
  const mine = new Player(question.options, names, () => room(names.length));
  player = mine;
  const options = player.canvases.map((canvas, place) =>
    element("figure", {}, names.length > 1 ? element("figcaption", {}, letterOf(place)) : null,
      canvas, answering.pointers[place]));
  const prompt = element("h2", { id: "prompt", tabIndex: -1 }, question.prompt);
  byId("main").replaceChildren(...[
    prompt,
    question.note && element("p", { className: "note" }, question.note),
    question.again && element("p", { className: "note" }, "You took back your answer to this one; please answer it again."),
    element("div", { className: "options" }, ...options),
    player.controls, answering.sofar, answering.others, beside(),
  ].filter(Boolean));
  prompt.focus();
  byId("spoken").textContent = byId("count").textContent;
  since = performance.now();
  mine.start(true).catch((error) => {
    if (player === mine) notice(`A picture cannot be shown: ${error.message} You can say “Cannot say”.`);
  });
}

/** What can be done beside answering. */
function beside() {
  const worth = state.learned.worth_asking ? null : element("p", { className: "note" },
    "Another answer is expected to teach next to nothing: you can stop here, or go on.");
  const last = state.answers.at(-1);
  const back = button("Undo the last answer", "u", undoLast, { disabled: last === undefined });
  return element("div", { className: "beside" }, worth, back, button("Stop here", null, stop));
}

const ENDS = {
  budget: ["Thank you!", "That was the last question."],
  no_more: ["Thank you!", "There is nothing more to ask."],
  stopped: ["You stopped here.", "You can go on now, or later with the same code."],
};

function showEnd() {
  byId("count").textContent = `${state.answered} answers`;
  const [heading, sentence] = ENDS[state.end.reason];
  const title = element("h2", { tabIndex: -1 }, heading);
  byId("main").replaceChildren(...[
    element("section", { className: "end" }, title,
      element("p", {}, `${sentence} All ${state.answered} answers are saved, and you can close this page.`),
      state.end.reason !== "stopped" ? null
        : button("Go on", null, () => change("/api/go_on", {}), { className: "main" }),
      state.answers.length === 0 ? null : button("Undo the last answer", "u", undoLast)),
  ]);
  title.focus();
}

/** Change something on the server, and show what is then. */
async function change(path, body) {
  if (answering?.busy) return;
  if (answering) {
    answering.busy = true;
    answering.close();
  }
  player?.pause();
  const { code } = state;
  const { status, content } = await surely(() => post(path, { code, ...body }));
  const next = status === 200 ? content : content.state;
  if (next) show(next);
  else if (status === 404) {
    kept.removeItem("code");
    welcome();
  } else if (answering) {
    show(state);
  }
  if (status !== 200) notice(content.error);
  return status;
}

async function answer(number) {
  const said = {
    key: state.question.key, answer: number,
    seconds: (performance.now() - since) / 1000, replays: player.replays,
  };
  if (answering.busy) return;
  kept.setItem("answer", JSON.stringify({ code: state.code, ...said }));
  if ((await change("/api/answer", said)) !== NO_KEY) kept.removeItem("answer");
}

const undo = (key) => change("/api/undo", { key });
const undoLast = () => state.answers.length > 0 && undo(state.answers.at(-1).key);
const stop = () => change("/api/stop", {});

/** Keys that a focused element has use for itself. */
function needed(event) {
  const { tagName, type } = event.target;
  if (tagName === "INPUT" && type !== "range") return true;
  return [" ", "Enter"].includes(event.key) && ["BUTTON", "SUMMARY", "INPUT"].includes(tagName);
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || needed(event)) return;
  const key = event.key.toLowerCase();
  const watching = { " ": () => player?.toggled(), r: () => player?.replay(), s: () => player?.nextSpeed() };
  if (answering?.pressed(key)) event.preventDefault();
  else if (player && key in watching) {
    event.preventDefault();
    watching[key]();
  } else if (key === "u" && state !== null) undoLast();
});

// Somebody may have answered in another tab meanwhile.
addEventListener("visibilitychange", async () => {
  if (document.hidden || state === null || answering?.busy || kept.getItem("code") === null) return;
  const shown = state;
  const { status, content } = await surely(() => get(`/api/state?code=${encodeURIComponent(state.code)}`));
  if (status === 200 && state === shown && JSON.stringify(content) !== JSON.stringify(shown)) show(content);
});

begin();
