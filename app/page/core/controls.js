/** Keyboard shortcuts and buttons of the page. */

/** @import { Page } from './page.js' */

import { element, html, pageScrolls } from './dom.js';
import { bindKeys } from './keys.js';
import { bindMaximise, toggleMaximised } from './maximise.js';

/** @param {Page} page */
export function bindControls(page) {
  const { clock, timeline, undo, theme } = page;
  const showHelp = () => element('#keys', HTMLDialogElement).showModal();
  const tabKeys = [...document.querySelectorAll('[role=tab]')].map((tab) => [
    tab.getAttribute('aria-keyshortcuts'),
    () => page.openTab(tab.id.replace('tab-', '')),
  ]);
  /** @param {number} steps */
  const stepBy = (steps) => (/** @type {KeyboardEvent} */ event) =>
    page.stepBy(event.shiftKey ? 10 * steps : steps, event.timeStamp);
  bindKeys({
    ...Object.fromEntries(tabKeys),
    ' ': () => clock.toggle(),
    ArrowLeft: stepBy(-1),
    ArrowRight: stepBy(1),
    PageUp: ({ timeStamp }) => page.stepBy(timeline.pageStep, timeStamp),
    PageDown: ({ timeStamp }) => page.stepBy(-timeline.pageStep, timeStamp),
    Home: ({ timeStamp }) => page.stepBy(-Infinity, timeStamp),
    End: ({ timeStamp }) => page.stepBy(Infinity, timeStamp),
    '<': () => clock.changeSpeed(-1),
    '>': () => clock.changeSpeed(1),
    '[': () => page.markIntervention('from'),
    ']': () => page.markIntervention('to'),
    'ctrl+k': () => page.commands.toggle(),
    'ctrl+z': () => undo.undo(),
    'ctrl+shift+z': () => undo.redo(),
    'ctrl+y': () => undo.redo(),
    '+': () => timeline.zoom(0.5),
    '=': () => timeline.zoom(0.5),
    '-': () => timeline.zoom(2),
    0: () => timeline.showAll(),
    n: ({ timeStamp }) => page.goToFailure(1, timeStamp),
    b: ({ timeStamp }) => page.goToFailure(-1, timeStamp),
    c: () => page.selectNextComponent(),
    d: () => theme.toggle(),
    e: () => page.goToLargestError(),
    j: () => page.jobs.toggleByKey(),
    l: () => page.live.newest(),
    m: () => page.maps.togglePin(),
    p: () => page.maps.switchQuantity(),
    s: () => page.save(),
    x: toggleMaximised,
    y: () => page.copyLink(),
    '?': showHelp,
  });
  bindButtons(page, showHelp);
  bindMaximise();
}

/**
 * @param {Page} page
 * @param {() => void} showHelp
 */
function bindButtons(page, showHelp) {
  /** @type {[string, (event: MouseEvent) => void][]} */
  const actions = [
    ['#play', () => page.clock.toggle()],
    ['#back', ({ timeStamp }) => page.stepBy(-1, timeStamp)],
    ['#forward', ({ timeStamp }) => page.stepBy(1, timeStamp)],
    ['#theme', () => page.theme.toggle()],
    ['#help', showHelp],
    ['#find', () => page.commands.toggle()],
    ['#reset-zoom', () => page.timeline.showAll()],
    ['#largest-error', () => page.goToLargestError()],
  ];
  for (const [selector, action] of actions) html(selector).addEventListener('click', action);
  for (const selector of ['#heatmaps', '#map-tiles', '#camera'])
    html(selector).addEventListener(
      'wheel',
      (event) => {
        if (pageScrolls()) return;
        event.preventDefault();
        page.stepBy(Math.sign(event.deltaY || event.deltaX), event.timeStamp);
      },
      { passive: false },
    );
}
