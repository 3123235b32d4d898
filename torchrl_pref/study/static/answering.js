// The buttons and keys by which a question is answered.

import { button, element } from "./elements.js";

const CANNOT_SAY = "?";
const ORDINALS = ["first", "second", "third", ...Array.from({ length: 22 }, (_, n) => `${n + 4}th`)];

/** A key pressed within so many milliseconds of a new question was meant for the one before. */
const UNSEEN = 300;

export class Answering {
  /**
   * @param question as the server tells it
   * @param give what is done with an answer: its number, or null where the person cannot say
   */
  constructor(question, give) {
    this.answers = question.answers;
    this.give = (answer) => {
      if (performance.now() - this.since > UNSEEN) give(answer);
    };
    this.since = performance.now();
    this.pointed = [];
    this.pointers = question.options.map((_, place) => this.pointer(place));
    this.others = element("div", { className: "others" });
    for (const one of this.answers) {
      if (one.places === null || this.isAlone(one)) {
        this.others.append(button(one.label, one.key, () => this.give(one.answer)));
      }
    }
    if (question.cannot_say) {
      this.others.append(button("Cannot say", CANNOT_SAY, () => this.give(null)));
    }
    this.sofar = element("p", { className: "sofar", role: "status" });
    this.told();
  }

  /** Whether an answer has a button of its own, as it is no pointing at options. */
  isAlone(one) {
    return one.places.length === 0 || this.pointers.length === 1;
  }

  /** The answers that begin with pointing at these places. */
  beginning(pointed) {
    return this.answers.filter(
      (one) =>
        one.places !== null && !this.isAlone(one) &&
        pointed.every((place, number) => one.places[number] === place),
    );
  }

  /** The button of an option; null where answers are no pointing. */
  pointer(place) {
    const letter = letterOf(place);
    const usable = this.answers.some((one) => one.places?.includes(place));
    if (!usable || this.answers.every((one) => (one.places?.length ?? 0) < 2 && one.key === "y"))
      return null;
    return button(`Choose ${letter}`, letter.toLowerCase(), () => this.point(place), {
      className: "choose",
    });
  }

  point(place) {
    if (place === this.pointed.at(-1)) {
      this.takeBack();
      return;
    }
    const next = [...this.pointed, place];
    const left = this.beginning(next);
    if (left.length === 0) return;
    if (left.length === 1) {
      this.give(left[0].answer);
      return;
    }
    this.pointed = next;
    this.told();
  }

  takeBack() {
    this.pointed.pop();
    this.told();
  }

  /** What was pointed at so far, on the buttons. */
  told() {
    const inOrder = this.beginning([]).some((one) => one.places.length > 1);
    this.pointers.forEach((one, place) => {
      if (one === null) return;
      const when = this.pointed.indexOf(place);
      one.setAttribute("aria-pressed", String(when >= 0));
      one.firstChild.data = when < 0 ? `Choose ${letterOf(place)}` : `${letterOf(place)} is ${ORDINALS[when]}`;
      const possible = this.beginning([...this.pointed, place]).length > 0;
      one.disabled = !possible && place !== this.pointed.at(-1);
    });
    const done = this.pointed.map(letterOf);
    this.sofar.hidden = !inOrder;
    this.sofar.textContent = done.length > 0
      ? `So far: ${done.join(", then ")}. Choose ${done.at(-1)} again to take it back.`
      : "Choose them one after the other, in that order.";
  }

  /** Whether a key was one of these buttons. */
  pressed(key) {
    const place = this.pointers.findIndex((one, at) => one && letterOf(at).toLowerCase() === key);
    const alone = this.answers.find((one) => one.key === key);
    if (place >= 0) this.point(place);
    else if (alone) this.give(alone.answer);
    else if (key === CANNOT_SAY) this.give(null);
    else return false;
    return true;
  }

  /** Nothing more can be pressed, as an answer is on its way. */
  close() {
    for (const one of [...this.pointers, ...this.others.children]) if (one) one.disabled = true;
  }
}

export const letterOf = (place) => String.fromCharCode(65 + place);
