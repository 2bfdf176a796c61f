/**
 * Runs in the scene's frame before viser does, as a plain script, and hands viser its animation frames. They are the
 * page's too: without a GPU each of viser's drawings holds everything up for 0.3 s, and viser draws once a second even
 * where nothing moves. So drawings are timed, and where they are slow the page may have them wait: `drawing.pause`.
 */
(() => {
  const SLOW = 60; // ms from a drawing to the next frame; less counts as nothing
  const MOST = 600; // ms that are believed: the first picture takes longer than any after it
  const FORGOTTEN = 1000; // ms after which an endless pause ends if nobody asks for it again
  const frame = window.requestAnimationFrame.bind(window);
  const waiting = new Map(); // viser's callbacks by their handles
  let handle = 0;
  let asked = false; // whether a frame is
  let timer = 0;
  let drew = false; // whether one of the callbacks of the last frame has
  let [began, ended] = [0, 0]; // the last drawing
  let costs = [0, 0]; // ms of the last two drawings
  let [times, until] = [0, 0]; // what follows a drawing: a pause of so many times its cost, and when that is over

  /** ms; the lesser of two, because one may have been another's fault. */
  const cost = () => Math.min(...costs);

  function ask() {
    clearTimeout(timer);
    if (asked || !(waiting.size || drew)) return;
    const rest = drew ? 0 : until - performance.now(); // the frame after a drawing tells how long it took
    if (rest > 0) timer = setTimeout(ask, rest);
    else [asked] = [true, frame(tick)];
  }

  function tick(now) {
    if (drew) {
      ended = performance.now();
      costs = [costs[1], ended - began > SLOW ? Math.min(ended - began, MOST) : 0];
      drew = false;
      drawing.told?.(drawing.slow());
      pause(times);
    }
    if (performance.now() >= until) run(now);
    asked = false;
    ask();
  }

  function run(now) {
    began = performance.now();
    for (const [key, callback] of [...waiting]) {
      if (!waiting.delete(key)) continue; // one before it has cancelled it
      try {
        callback(now);
      } catch (error) {
        reportError(error);
      }
    }
  }

  /** From now on a pause of so many times its cost follows each slow drawing. Whether the next may be at once. */
  function pause(wanted) {
    times = wanted;
    const endless = times === Infinity;
    until = !cost() || !times ? 0 : endless ? performance.now() + FORGOTTEN : ended + times * cost();
    ask();
    return performance.now() >= until;
  }

  window.requestAnimationFrame = (callback) => {
    waiting.set(++handle, callback);
    ask();
    return handle;
  };
  window.cancelAnimationFrame = (key) => void waiting.delete(key);
  const { clear } = WebGL2RenderingContext.prototype; // every drawing begins with it
  WebGL2RenderingContext.prototype.clear = function (mask) {
    drew = true;
    return clear.call(this, mask);
  };
  // To a hidden page viser applies what it is told as it comes, else as it draws, and then the first picture is half old.
  const { get: hidden } = Object.getOwnPropertyDescriptor(Document.prototype, 'hidden');
  Object.defineProperty(document, 'hidden', { get: () => drawing.slow() || hidden.call(document) });
  // viser warns of drawing without a GPU, across the scene, each time; the page says what follows from it.
  const { getExtension } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.getExtension = function (name) {
    return name === 'WEBGL_debug_renderer_info' ? null : getExtension.call(this, name);
  };
  // Where the frame is narrow, viser takes it for a telephone's screen and covers a quarter of it with its panel.
  const { matchMedia } = window;
  window.matchMedia = (query) => matchMedia.call(window, query.includes('max-width') ? 'not all' : query);
  /** `told`, if somebody sets it, is called after each drawing with whether drawing is slow. */
  const drawing = (window.drawing = { pause, slow: () => cost() > 0, told: null });
})();
