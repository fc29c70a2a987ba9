/** What the console asks the person who commissions, and what it says to them: always as text. */

import { html, useEffect, useId, useRef, useState } from "../html.js";
import { HoldButton } from "./hold_button.js";

const FRESH_MS = 500;

/** The question of a conversation's view, with the controls that answer it; nothing without one. */
export function QuestionPart({ talk }) {
  const { question, held } = talk.view;
  if (!question) return null;
  const parts = { text: TextQuestion, number: TextQuestion, choice: Choices, change: Change, hold: Hold };
  return html`<div class="question" key=${question.number} role="group" aria-label="Question">
    <${parts[question.kind]} key=${question.number} question=${question} held=${held}
      answer=${(text) => talk.answer(question.number, text)} talk=${talk} />
  </div>`;
}

/** What was said since something began; the end of it is in sight. */
export function Lines({ lines }) {
  const place = useRef();
  useEffect(() => {
    place.current.scrollTop = place.current.scrollHeight;
  }, [lines.length]);
  return html`<pre class="lines" ref=${place} tabindex="0" role="log" aria-label="What was said">${lines.join("\n")}</pre>`;
}

/** A command to be typed, with a button that copies it. */
export function CopiedCommand({ command }) {
  const [copied, setCopied] = useState(false);
  async function copy() {
    await navigator.clipboard.writeText(command);
    setCopied(true);
  }
  return html`<p class="row command"><code>${command}</code>
    <button type="button" onClick=${copy}>Copy the command</button>
    <span role="status">${copied ? "Copied" : ""}</span></p>`;
}

/** A question that has just come cannot be answered: the second Enter or click was meant for the one before it. */
function useFresh() {
  const [fresh, setFresh] = useState(true);
  useEffect(() => {
    const timer = setTimeout(() => setFresh(false), FRESH_MS);
    return () => clearTimeout(timer);
  }, []);
  return fresh;
}

function TextQuestion({ question, answer }) {
  const fresh = useFresh();
  const [text, setText] = useState(question.default ?? "");
  const id = useId();
  const field = useRef();
  useEffect(() => field.current.focus(), []);
  const likely = question.choices ?? [];
  const held = (event) => event.repeat && event.key === "Enter"; // it was pressed for the question before
  return html`<form class="row" onKeyDown=${(event) => held(event) && event.preventDefault()} onSubmit=${(event) => {
    event.preventDefault();
    answer(field.current.value);
  }}>
    <div class="field">
      <label for=${id}>${question.text}</label>
      <input id=${id} ref=${field} type="text" inputmode=${question.kind === "number" ? "decimal" : null} maxlength="400"
        autocomplete="off" value=${text}
        onInput=${({ target }) => setText(target.value)} />
    </div>
    ${likely.map(({ word }) => html`<button key=${word} type="button" class="plain" onClick=${() => setText(word)}>${word}</button>`)}
    <button class="main" disabled=${fresh}>Answer</button>
  </form>`;
}

function Choices({ question, answer }) {
  const fresh = useFresh();
  return html`<p>${question.text}?</p>
    <p class="row">${question.choices.map(
      ({ word, label }) => html`<button key=${word} type="button" disabled=${fresh} onClick=${() => answer(word)}>${label}</button>`,
    )}</p>`;
}

function Change({ question, answer }) {
  const kinds = { "+": "added", "-": "removed" };
  return html`<p>${question.text}?</p>
    <pre class="change" tabindex="0" aria-label="The change">${(question.lines ?? []).map(
      (line) => html`<span class=${kinds[line[0]] ?? ""}>${line}${"\n"}</span>`,
    )}</pre>
    <${Choices} question=${{ ...question, text: "Write or leave" }} answer=${answer} />`;
}

function Hold({ question, held, talk }) {
  return html`<p>While you hold the button, or the space bar on it: ${question.text}. Letting go halts it.</p>
    <p class="row"><${HoldButton} kind="main" begin=${() => talk.hold(question.number)} end=${() => talk.letGo()}
      >Hold to move<//> <span role="status" class="mark" data-level=${held ? "warn" : null}>${held ? "It may move now" : "It is halted"}</span></p>`;
}
