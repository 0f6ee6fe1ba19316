// Play, pause and seek in a recording. One frame is asked for at a time: the latest that is wanted.

import { element, write } from "./panels.js";
import { fixed } from "./numbers.js";

export class Transport {
  /** @param order sends an order to ohmskin; wake has advance() called when the browser paints next */
  constructor(order, wake) {
    this.order = order;
    this.wake = wake;
    this.playing = false;
    this.position_s = 0;
    this.seconds = 0;
    this.frames = 0;
    this.complete = false;
    this.wanted = null;
    this.waiting = false;
    element("play").addEventListener("click", () => this.toggle());
    element("back").addEventListener("click", () => this.step(-1));
    element("forward").addEventListener("click", () => this.step(1));
    element("position").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    element("position").addEventListener("keydown", (event) => {
      const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
      if (way === undefined) return;
      event.preventDefault();
      this.step(way);
    });
  }

  /** Begins anew, when the connection has been opened. */
  restart() {
    this.waiting = false;
    this.want({ do: "show time", time_s: this.position_s });
  }

  /** Takes in how far the recording is decoded. */
  learn(status) {
    this.seconds = status.seconds;
    this.frames = status.frames;
    this.complete = status.state === "recording";
    element("position").max = String(this.seconds);
    element("position").value = String(this.position_s);
    this.tell();
  }

  /** A frame has come. */
  arrived(frame) {
    this.waiting = false;
    this.shown = frame;
    if (!this.playing && this.wanted === null) {
      this.position_s = frame.time_s;
      element("position").value = String(frame.time_s);
    }
    this.tell();
    this.ask();
  }

  /** Moves on while playing. */
  advance() {
    if (!this.playing) return;
    const now = performance.now();
    this.position_s += ((now - this.since_ms) / 1e3) * Number(element("speed").value);
    this.since_ms = now;
    if (this.position_s >= this.seconds) {
      this.position_s = this.seconds;
      if (this.complete) this.toggle();
    }
    element("position").value = String(this.position_s);
    this.want({ do: "show time", time_s: this.position_s });
    this.wake();
  }

  seek(time_s) {
    this.position_s = time_s;
    element("position").value = String(time_s);
    this.want({ do: "show time", time_s });
  }

  step(way) {
    if (this.playing) this.toggle();
    if (this.shown) this.want({ do: "show number", number: Math.max(this.shown.number + way, 0) });
  }

  toggle() {
    this.playing = !this.playing;
    if (this.playing && this.complete && this.position_s >= this.seconds) this.position_s = 0;
    write(element("play"), this.playing ? "Pause" : "Play");
    this.since_ms = performance.now();
    this.wake();
  }

  /** No frame comes for the last order. */
  refused() {
    this.waiting = false;
  }

  want(order) {
    this.wanted = order;
    this.ask();
  }

  ask() {
    if (this.waiting || this.wanted === null) return;
    this.waiting = true;
    this.order(this.wanted);
    this.wanted = null;
  }

  tell() {
    const shown = this.shown ? `frame ${this.shown.number + 1} of ${this.frames}` : "";
    const place = `${fixed(this.shown?.time_s ?? 0, 2)} s of ${fixed(this.seconds, 2)} s`;
    write(element("clock"), `${place}${shown && " · "}${shown}${this.complete ? "" : " so far"}`);
  }
}
