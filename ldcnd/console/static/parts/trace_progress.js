/** How far the trace of an axis is. */

import { html } from "../html.js";
import { percent, words } from "./format.js";

/** The phase in words, and while a drive's memory is read, how much of it has been. */
export function TraceProgress({ trace }) {
  if (!trace) return html`<p role="status"></p>`;
  const { phase, samples, channels, problem, uploaded } = trace;
  const what = `${samples} samples of ${channels.map((each) => words(each.name)).join(", ")}`;
  return html`<p role="status">${words(phase)}: ${what}${problem ? `; ${problem}` : ""}</p>
    ${
      typeof uploaded === "number" &&
      html`<p class="row"><progress aria-label="Upload of the trace" max="1" value=${uploaded}></progress>
      <span class="quiet">${percent(uploaded)}</span></p>`
    }`;
}
