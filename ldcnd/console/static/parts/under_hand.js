/** Whether a press means the button that it meets.
 *
 * A reset that is done makes its button another one, and a message above a table moves its rows: what comes under a hand
 * that rests is not what the hand has chosen, however long it rests.
 */

const PLACE_PX = 12;
let last = null; // the press before: where, on what, and whether the hand has left that place since

addEventListener("pointermove", (event) => {
  if (last && !near(event)) last.left = true;
}, { capture: true, passive: true });

const near = ({ clientX, clientY }) => Math.hypot(clientX - last.x, clientY - last.y) <= PLACE_PX;

/** Return what to tell a person whose press met a button that has come under a resting hand; null for every other press.

 * The next press at that place means it.
 */
export function cameUnderHand(event) {
  const byKey = event.type === "click" && event.detail === 0;
  if (byKey) return null;
  const what = event.currentTarget.textContent.trim();
  const came = last !== null && !last.left && near(event) && last.what !== what;
  last = { x: event.clientX, y: event.clientY, what, left: false };
  return came ? `Not done: this button has come under your hand since the last press. Press again for ${what}.` : null;
}
