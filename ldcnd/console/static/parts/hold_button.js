/** A button that lets something move while it is held, whatever ends that: finger, key, focus, window or page. */

import { html, useLayoutEffect, useRef } from "../html.js";
import { cameUnderHand } from "./under_hand.js";

/** `begin` and `end` come in turn; `keys` are held like the space bar; `obstacle` says why it cannot be held now. */
export function HoldButton({ begin, end, keys = [], obstacle = null, reason = null, kind = "", children }) {
  const holding = useRef(false);
  const act = useRef({});
  act.current = { begin, end };

  function press() {
    if (obstacle || holding.current) return;
    holding.current = true;
    act.current.begin();
  }
  function letGo() {
    if (!holding.current) return;
    holding.current = false;
    act.current.end();
  }
  useLayoutEffect(() => {
    const hidden = () => document.hidden && letGo();
    addEventListener("blur", letGo);
    addEventListener("pagehide", letGo);
    document.addEventListener("visibilitychange", hidden);
    return () => {
      letGo();
      removeEventListener("blur", letGo);
      removeEventListener("pagehide", letGo);
      document.removeEventListener("visibilitychange", hidden);
    };
  }, []);

  const mine = (event) => event.key === " " || event.key === "Enter" || keys.includes(event.key);
  return html`<button type="button" class=${`hold ${kind}`} aria-disabled=${obstacle ? "true" : null}
    aria-describedby=${obstacle ? reason : null}
    onPointerDown=${(event) => {
      if (event.button !== 0 || cameUnderHand(event)) return;
      event.target.setPointerCapture(event.pointerId);
      press();
    }}
    onPointerUp=${letGo} onPointerCancel=${letGo} onLostPointerCapture=${letGo} onBlur=${letGo}
    onContextMenu=${(event) => event.preventDefault()}
    onKeyDown=${(event) => {
      if (!mine(event)) return;
      event.preventDefault();
      if (!event.repeat) press();
    }}
    onKeyUp=${(event) => mine(event) && letGo()}>${children}</button>`;
}
