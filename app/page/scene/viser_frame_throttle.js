/**
 * Throttles viser's animation frames, and adapts viser to the page. A plain script that runs in the frame of the 3D scene before viser.
 *
 * The frame shares its thread with the page. Without a GPU each rendering can block both for 0.1 s, and viser renders
 * once a second even without changes. Renderings are therefore timed, and where they are slow the page can set a
 * pause between them: `frameThrottle.pause`.
 */
(() => {
  const SLOW = 40; // ms from a rendering to the next frame; less counts as fast
  const MAX_COST = 600; // ms; the first rendering takes longer than the following ones
  const PAUSE_TIMEOUT = 1000; // ms until an endless pause ends unless it is renewed
  const requestFrame = window.requestAnimationFrame.bind(window);
  /** Pending callbacks by handle. @type {Map<number, FrameRequestCallback>} */
  const callbacks = new Map();
  let handle = 0;
  let requested = false;
  /** @type {number | undefined} */
  let timer;
  let rendered = false; // whether a callback of the last frame rendered
  let [start, end] = [0, 0]; // ms, of the last rendering
  let costs = [0, 0]; // ms, of the last two renderings
  let [factor, pauseEnd] = [0, 0];

  // The minimum of two, because other work may have delayed one of them.
  const cost = () => Math.min(...costs);

  function schedule() {
    clearTimeout(timer);
    if (requested || !(callbacks.size || rendered)) return;
    // The frame after a rendering measures its duration, and is not delayed.
    const delay = rendered ? 0 : pauseEnd - performance.now();
    if (delay > 0) {
      timer = window.setTimeout(schedule, delay);
    } else {
      requested = true;
      requestFrame(tick);
    }
  }

  /** @param {number} now */
  function tick(now) {
    if (rendered) {
      end = performance.now();
      costs = [costs[1], end - start > SLOW ? Math.min(end - start, MAX_COST) : 0];
      rendered = false;
      throttle.changed?.(throttle.slow());
      pause(factor);
    }
    if (performance.now() >= pauseEnd) run(now);
    requested = false;
    schedule();
  }

  /** @param {number} now */
  function run(now) {
    start = performance.now();
    for (const [key, callback] of [...callbacks]) {
      if (!callbacks.delete(key)) continue; // cancelled by an earlier callback
      try {
        callback(now);
      } catch (error) {
        reportError(error);
      }
    }
  }

  /** @param {number} value */
  function pause(value) {
    factor = value;
    if (!cost() || !factor) pauseEnd = 0;
    else if (factor === Infinity) pauseEnd = performance.now() + PAUSE_TIMEOUT;
    else pauseEnd = end + factor * cost();
    schedule();
    return performance.now() >= pauseEnd;
  }

  window.requestAnimationFrame = (callback) => {
    callbacks.set(++handle, callback);
    schedule();
    return handle;
  };
  window.cancelAnimationFrame = (key) => void callbacks.delete(key);
  const { clear } = WebGL2RenderingContext.prototype; // the first call of every rendering
  WebGL2RenderingContext.prototype.clear = function (/** @type {number} */ mask) {
    rendered = true;
    return clear.call(this, mask);
  };
  // On a hidden page viser applies messages as they arrive, otherwise while it renders: a slow rendering would show
  // only a part of them.
  const hidden = Object.getOwnPropertyDescriptor(Document.prototype, 'hidden')?.get;
  Object.defineProperty(document, 'hidden', {
    get: () => throttle.slow() || hidden?.call(document),
  });
  // Disables viser's warning about software rendering; the page has its own.
  const { getExtension } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.getExtension = function (/** @type {string} */ name) {
    return name === 'WEBGL_debug_renderer_info' ? null : getExtension.call(this, name);
  };
  // Disables viser's layout for phones, whose panel covers a quarter of a narrow frame.
  const { matchMedia } = window;
  window.matchMedia = (query) =>
    matchMedia.call(window, query.includes('max-width') ? 'not all' : query);
  // A frame whose color scheme differs from that of the page would be opaque: black or white.
  const page = window.parent.document.documentElement;
  const copyColorScheme = () => {
    const { colorScheme } = getComputedStyle(page);
    document.documentElement.style.setProperty('color-scheme', colorScheme, 'important');
  };
  copyColorScheme();
  new MutationObserver(copyColorScheme).observe(page, { attributeFilter: ['data-theme'] });
  // viser loads a module for Gaussian splats, which compiles code from text. The Content Security Policy of the frame
  // forbids that, and these scenes have no splats.
  window.addEventListener('unhandledrejection', (event) => {
    if (event.reason instanceof EvalError) event.preventDefault();
  });
  /** @type {import('./scene_frame.js').FrameThrottle} */
  const throttle = (window.frameThrottle = { pause, slow: () => cost() > 0, changed: null });
})();
