/** Keeps a press of the key that stops while the modules of the page are still on their way; `stop_all.js` takes it. */

function keepEarlyPress(event) {
  keepEarlyPress.came ||= event.key === "Escape";
}

addEventListener("keydown", keepEarlyPress, true);
