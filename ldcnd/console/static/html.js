/** What pages are made of: the one place that knows where Preact comes from. */

export {
  html,
  render,
  useCallback,
  useEffect,
  useErrorBoundary,
  useLayoutEffect,
  useMemo,
  useRef,
  useState,
} from "./vendor/htm/standalone.module.js";

import { useState } from "./vendor/htm/standalone.module.js";

let named = 0;

/** Return an id that no other element of the page has. */
export function useId() {
  return useState(() => `id${++named}`)[0];
}
