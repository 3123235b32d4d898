// Trajectories that play side by side, by one clock.

import { button, element } from "./elements.js";
import { aspect, corners, draw, framesOf } from "./scene.js";

/** Seconds that a play takes at the speed 1. */
const SECONDS = 4;

const SPEEDS = [1, 2, 0.5];
let speed = 0; // of SPEEDS: kept from question to question

export const reducedMotion = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

export class Player {
  /**
   * @param scenes of the trajectories
   * @param names what each is called, for those who cannot see it
   * @param room (width, height) in pixels that each may take: a function, as windows change
   */
  constructor(scenes, names, room) {
    this.scenes = scenes;
    this.room = room;
    this.replays = 0;
    this.box = corners(scenes);
    this.aspect = aspect(this.box, scenes[0].equal); // height over width
    this.canvases = names.map((name) => element("canvas", { role: "img", "aria-label": name }));
    this.controls = element("div", { className: "controls", role: "group", "aria-label": "Watch" });
    this.frames = null; // until images are loaded
    this.at = 1; // from the start to the end of the trajectory
    this.playing = false;
    this.resized = () => this.fit();
    addEventListener("resize", this.resized);
  }

  /** Load what is to be seen, and begin to play where people want motion. */
  async start(plays) {
    const loaded = await Promise.all(this.scenes.map(framesOf));
    this.frames = loaded.map((one) => one.frames);
    this.whole = loaded.every((one) => one.whole);
    this.length = Math.max(...this.frames.map((one) => one.length));
    const aspects = loaded.flatMap((one) => one.aspects);
    if (aspects.length > 0) this.aspect = Math.max(...aspects);
    if (this.length > 1) this.addControls();
    if (!this.whole) {
      this.controls.append("This browser shows only the first moment of it; others show all.");
    }
    this.fit();
    if (plays && this.length > 1 && !reducedMotion()) this.play(0);
  }

  addControls() {
    this.toggle = button("Pause", " ", () => this.toggled());
    this.again = button("Replay", "r", () => this.replay());
    this.faster = button("", "s", () => this.nextSpeed(), { "aria-label": "Speed" });
    this.slider = element("input", {
      type: "range", min: 0, max: this.length - 1, step: 1, "aria-label": "Moment",
      oninput: () => this.moveTo(Number(this.slider.value)),
    });
    this.controls.append(this.toggle, this.again, this.faster, this.slider);
    this.told();
  }

  toggled() {
    if (!(this.length > 1)) return; // one moment, or not loaded yet
    if (this.playing) this.pause();
    else if (this.at >= 1) this.replay();
    else this.play(this.at);
  }

  replay() {
    if (!(this.length > 1)) return; // one moment, or not loaded yet
    this.replays += 1;
    this.play(0);
  }

  nextSpeed() {
    if (!(this.length > 1)) return; // one moment, or not loaded yet
    speed = (speed + 1) % SPEEDS.length;
    this.told();
  }

  play(from) {
    this.at = from;
    if (!this.playing) {
      this.playing = true;
      this.before = null;
      requestAnimationFrame((now) => this.tick(now));
    }
    this.told();
  }

  pause() {
    this.playing = false;
    this.told();
  }

  moveTo(frame) {
    this.playing = false;
    this.at = frame / (this.length - 1);
    this.show();
    this.told();
  }

  tick(now) {
    if (!this.playing) return;
    if (this.before !== null) this.at += ((now - this.before) / 1000 / SECONDS) * SPEEDS[speed];
    this.before = now;
    if (this.at >= 1) {
      this.at = 1;
      this.pause();
    }
    this.show();
    if (this.playing) requestAnimationFrame((next) => this.tick(next));
  }

  /** What is being done, on the buttons. */
  told() {
    if (!this.toggle) return;
    this.toggle.firstChild.data = this.playing ? "Pause" : "Play";
    this.faster.firstChild.data = { 1: "1×", 2: "2×", 0.5: "½×" }[SPEEDS[speed]];
    this.faster.setAttribute("aria-label", `Speed ${SPEEDS[speed]}`);
  }

  /** Make the canvases as large as there is room. */
  fit() {
    if (this.frames === null) return;
    const [most, high] = this.room();
    const width = Math.min(most, Math.max(60, high / this.aspect));
    for (const canvas of this.canvases) {
      canvas.style.width = `${width}px`;
      canvas.style.height = `${width * this.aspect}px`;
      canvas.width = Math.round(width * devicePixelRatio);
      canvas.height = Math.round(width * this.aspect * devicePixelRatio);
    }
    this.show();
  }

  show() {
    const frame = Math.round(this.at * (this.length - 1));
    this.canvases.forEach((canvas, number) => {
      const frames = this.frames[number];
      draw(canvas, frames[Math.min(frame, frames.length - 1)], this.box);
    });
    if (this.slider) this.slider.value = frame;
  }

  /** Stop, for good. */
  close() {
    this.playing = false;
    removeEventListener("resize", this.resized);
  }
}
