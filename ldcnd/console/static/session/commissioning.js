/** Commissioning: what the console shows of it, and a conversation that lasts as long as its web socket is open. */

import { Refusal, read } from "./api.js";

const OVERVIEW_EACH_MS = 1_000;
const OPEN_AGAIN_MS = 1_000;
/** As the console wants it, several times over. */
const HELD_EACH_MS = 100;

/** Call `show` with the overview, or with why there is none, until what is returned is called. */
export function followOverview(show) {
  let over = false;
  (async () => {
    while (!over) {
      if (!document.hidden) {
        try {
          show(await read("/api/commissioning"), null);
        } catch (error) {
          show(null, error);
        }
      }
      await new Promise((resolve) => setTimeout(resolve, OVERVIEW_EACH_MS));
    }
  })();
  return () => {
    over = true;
  };
}

/** Speaks with the console about an axis, or about the search for drives; `path` is below /api/commissioning. */
export class Conversation {
  view = null;
  refused = null;
  #socket = null;
  #holding = 0;
  #over = false;

  constructor(path, changed) {
    this.path = path;
    this.changed = changed;
    this.#open();
  }

  /** Begin a step of the checklist, or the search. */
  begin(name, by) {
    this.#say({ begin: name, by });
  }

  answer(number, text) {
    this.#say({ answer: { number, text } });
  }

  /** End what is going on. */
  leave() {
    this.#say({ leave: true });
  }

  /** Say that the button is held, until `letGo`. */
  hold(number) {
    this.letGo();
    const say = (on) => this.#say({ hold: { number, on } });
    say(true);
    this.#holding = setInterval(() => say(true), HELD_EACH_MS);
    this.endHold = () => say(false);
  }

  letGo() {
    if (!this.#holding) return;
    clearInterval(this.#holding);
    this.#holding = 0;
    this.endHold();
  }

  /** The page goes: nothing of it runs on. */
  close() {
    this.#over = true;
    this.letGo();
    this.#socket.close();
  }

  #say(message) {
    if (this.#socket.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  #open() {
    this.#socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/api/commissioning/${this.path}`);
    this.#socket.onmessage = ({ data }) => {
      const { view, refused } = JSON.parse(data);
      this.refused = refused ? new Refusal(refused, 0) : null;
      if (view) this.view = view;
      this.changed();
    };
    this.#socket.onclose = () => {
      this.letGo();
      this.view = null;
      if (this.#over) return;
      this.changed();
      setTimeout(() => this.#over || this.#open(), OPEN_AGAIN_MS);
    };
  }
}
