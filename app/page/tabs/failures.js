/** Where the filter fails over the whole data set: events by rank, the worst first, or its episodes. The search is a job. */

import * as api from '../data/api.js';
import { copyText } from '../core/clipboard.js';
import { Episodes } from './episodes.js';
import { pending, jobSummary, isActive } from '../widgets/jobs.js';
import { choice } from '../widgets/pickers.js';
import { setTabStop, navigateRows } from '../widgets/row_navigation.js';
import { DISPLAY_UNITS, fixed, percent, sentence, significant } from '../core/units.js';

const LISTS = [
  ['events', 'Events'],
  ['episodes', 'Episodes'],
];
const AMONG = [
  ['held-out', 'held-out'],
  ['all', 'all'],
];
const NAMES = { nees: 'NEES', ess: 'ESS' };
const UNITS = { sigma: 'σ', x: '×' };
const TOLD = 1500; // ms
const LINK =
  '<svg viewBox="0 0 16 16" aria-hidden="true"><path d="m6.3 9.7 3.4-3.4M7 4.6l1.4-1.3a2.9 2.9 0 0 1 4.2 4.1L11.2 8.8M9 11.4l-1.4 1.3a2.9 2.9 0 0 1-4.2-4.1L4.8 7.2"/></svg>';
const KEPT = 8; // results

/**
 * @typedef {object} Result what is known of one filter over one data set
 * @property {'loading' | 'ready' | 'absent' | 'active' | 'ended' | 'error' | 'waits'} state `waits`: for the end of a live run
 * @property {api.Failures} [found] @property {api.Job} [job] @property {string} [error]
 */

export class Failures {
  #host;
  #store;
  #jobs;
  #timeline;
  #episodes;
  #trace = null;
  /** @type {Map<string, Result>} */
  #results = new Map();
  #loading = new AbortController();
  #rows = []; // of the events, as they were listed last: {failure, row, button}
  #last = -1; // place of the failure that was gone to last
  #listed = ''; // what the rows are of
  #sought = ''; // the key of what the worst failure is waited for

  /**
   * @param {HTMLElement} host @param {import('../core/state.js').Store} store @param {import('../widgets/jobs.js').Jobs} jobs
   * @param {import('../timeline/timeline.js').Timeline} timeline that gets the marks @param {api.Catalog} catalog
   */
  constructor(host, store, jobs, timeline, catalog) {
    [this.#host, this.#store, this.#jobs, this.#timeline] = [host, store, jobs, timeline];
    this.#episodes = new Episodes(this.#part('.episodes'), store, catalog);
    navigateRows(this.#part('.events tbody'));
    jobs.listen((list) => this.#hear(list));
    this.load();
  }

  /** @param {import('../data/trace.js').Trace | null} trace that the time line shows; null while there is none. */
  show(trace) {
    this.#trace = trace;
    if (!this.#live) return this.#mark();
    this.#results.delete(this.#key); // another run may have its name by now
    this.load();
  }

  /** Marks the row at the cursor. */
  move(step) {
    const { episode } = this.#store.state;
    const at = (failure) => failure.episode === episode && failure.step === step;
    const place = this.#events.findIndex(at);
    if (place >= 0) this.#last = place;
    if (this.#host.hidden) return;
    this.#rows.forEach(({ failure, row, button }) => {
      const here = at(failure);
      if (here === row.classList.contains('here')) return;
      row.classList.toggle('here', here);
      if (here) button.setAttribute('aria-current', 'true');
      else button.removeAttribute('aria-current');
    });
  }

  /** Another task, filter, data set or faults, or other episodes of it: asks what is known. */
  async load() {
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    const key = this.#key;
    this.#last = -1;
    if (this.#sought !== key) this.#sought = '';
    if (this.#waiting) return this.draw();
    if (!this.#results.has(key)) this.#keep(key, { state: 'loading' });
    this.draw();
    if (this.#results.get(key).state === 'ready') return;
    try {
      this.#keep(key, pending(await api.failures(this.#store.state, signal)));
    } catch (error) {
      if (error.name === 'AbortError') return;
      this.#keep(key, { state: 'error', error: error.message });
    }
    this.draw();
    this.#seek();
  }

  /** Goes to the next failure of the list, or the one before. @param {1 | -1} by */
  go(by, inputTime) {
    const events = this.#events;
    if (!events.length) return this.#store.set({ tab: 'failures' });
    this.#last = Math.min(Math.max(this.#last + by, 0), events.length - 1);
    this.#open(events[this.#last], inputTime);
    const table = this.#part('.events');
    if (table.checkVisibility())
      setTabStop(this.#rows[this.#last].row, table.contains(document.activeElement));
  }

  /** Goes to the worst failure of all as soon as it is known; has it looked for where nobody did. */
  worst() {
    this.#sought = this.#key;
    this.#seek();
  }

  #seek() {
    if (this.#sought !== this.#key) return;
    const { state } = this.#known;
    if (state === 'absent') this.#look();
    if (state !== 'ready') return;
    [this.#sought, this.#last] = ['', -1];
    this.go(1);
  }

  /** Writes all that is known, by the chosen measure; only marks it on the time line while another tab is shown. */
  draw() {
    this.#mark();
    if (this.#host.hidden) return;
    const { state } = this.#store;
    const known = this.#known;
    const set = (key) => (value) => this.#store.set({ [key]: value });
    choice(this.#part('#list'), LISTS, state.list, set('list'));
    choice(this.#part('#among'), this.#live ? [] : AMONG, state.among, set('among'));
    this.#part('.events').hidden = state.list !== 'events';
    this.#part('.episodes').hidden = state.list !== 'episodes';
    this.#host.dataset.state = known.state;
    this.#host.setAttribute(
      'aria-busy',
      String(known.state === 'loading' || known.state === 'active'),
    );
    this.#doing(known);
    const score = this.#score;
    this.#measures(known.result?.scores ?? []);
    const line = score
      ? score.why_not
        ? `None by ${called(score)}: ${score.why_not}.`
        : score.verdict
      : said(known);
    const verdict = this.#part('.verdict');
    if (verdict.textContent !== line) verdict.textContent = verdict.title = line;
    this.#phases(score);
    this.#list(score);
    this.#episodes.show(known.result ?? null, score && !score.why_not ? score : null);
  }

  #part(selector) {
    return this.#host.querySelector(selector);
  }

  get #key() {
    const { task, filter, data, faults, among } = this.#store.state;
    return JSON.stringify([task, filter, data, faults, among]);
  }

  /** Whether it is of a live run: one episode. */
  get #live() {
    return this.#store.state.data.startsWith('live:');
  }

  /** How a live run is waited for of which not all steps are there; null of anything else. @returns {Result | null} */
  get #waiting() {
    if (!this.#live) return null;
    if (this.#trace?.selection.data !== this.#store.state.data) return { state: 'loading' };
    return this.#trace.live?.state === 'running' ? { state: 'waits' } : null;
  }

  /** @returns {Result} */
  get #known() {
    return this.#waiting ?? this.#results.get(this.#key) ?? { state: 'loading' };
  }

  /** The chosen measure, or the first where the filter's task has no such. */
  get #score() {
    const scores = this.#known.result?.scores;
    return scores?.find(({ name }) => name === this.#store.state.by) ?? scores?.[0];
  }

  /** The events of the chosen measure and phase; of all phases where the measure has no such. */
  get #events() {
    const score = this.#score;
    const { phase } = this.#store.state;
    if (!score?.events) return [];
    return score.phases.some((g) => g.name === phase)
      ? score.events.filter((m) => m.phase === phase)
      : score.events;
  }

  #keep(key, kept) {
    this.#results.delete(key);
    this.#results.set(key, kept);
    if (this.#results.size > KEPT) this.#results.delete(this.#results.keys().next().value);
  }

  async #look() {
    const key = this.#key;
    try {
      this.#keep(key, pending(await api.startFailureSearch(this.#store.state)));
    } catch (error) {
      this.#keep(key, { state: 'error', error: error.message });
    }
    this.draw();
    this.#jobs.refresh();
  }

  /** Jobs have changed: what is done is fetched. */
  #hear(list) {
    const byId = new Map(list.map((job) => [job.id, job]));
    for (const [key, { job }] of [...this.#results]) {
      if (!job) continue;
      const now = byId.get(job.id);
      if (now?.state === 'done') this.#results.delete(key);
      else this.#keep(key, pending({ job: now ?? null }));
    }
    if (this.#results.has(this.#key)) this.draw();
    else this.load();
  }

  /** The button that asks, tries again or cancels, and how far it is. */
  #doing({ state, job }) {
    const doing = this.#part('.doing');
    const acts = {
      unasked: 'Look for failures',
      ended: 'Try again',
      error: 'Try again',
      working: 'Cancel',
    }[state];
    if (doing.dataset.acts !== (acts ?? '')) {
      const focused = doing.contains(document.activeElement);
      doing.dataset.acts = acts ?? '';
      doing.replaceChildren(...(state === 'active' ? [document.createElement('progress')] : []));
      if (acts)
        doing.append(
          button(acts, 'text', () =>
            isActive(this.#known.job) ? this.#jobs.cancel(this.#known.job.id) : this.#look(),
          ),
        );
      if (focused) (doing.querySelector('button') ?? this.#part('.scroll')).focus();
    }
    const progress = doing.querySelector('progress');
    if (!progress) return;
    progress.setAttribute('aria-label', 'Progress of the search for failures');
    progress.value = job.progress;
  }

  /** Those that the filter lacks can be chosen too: then it is said why. */
  #measures(scores) {
    const host = this.#part('#by');
    choice(
      host,
      scores.map((score) => [score.name, called(score)]),
      this.#score?.name,
      (by) => this.#store.set({ by, ...drawn(by, this.#trace) }),
    );
    scores.forEach(({ title, why_not: why }, i) => {
      host.children[i].title = why ? `${sentence(title)} None: ${why}.` : `Rank by ${title}`;
      host.children[i].classList.toggle('lacking', Boolean(why));
    });
  }

  #phases(score) {
    const host = this.#part('#phase');
    const phases = (score?.phases ?? []).filter((g) => g.events);
    const chosen = phases.some((g) => g.name === this.#store.state.phase)
      ? this.#store.state.phase
      : '';
    const options = [
      ['', `all ${score?.total ?? ''}`],
      ...phases.map((g) => [
        g.name,
        `${g.name} ${g.events}${g.over_represented ? ` · ${fixed(g.lift)}×` : ''}`,
      ]),
    ];
    choice(host, options, chosen, (phase) => this.#store.set({ phase }));
    host.hidden = !phases.length || this.#store.state.list !== 'events';
    phases.forEach((g, i) => {
      host.children[i + 1].classList.toggle('over-represented', g.over_represented);
      host.children[i + 1].title =
        `${percent(g.share)} of the steps, ${percent(g.event_share)} of the events: ${fixed(g.lift)} times its share. Chance gives so many in ${significant(100 * g.p_value)} %.`;
    });
  }

  /** A row for each failure, made anew only when others are listed. */
  #list(score) {
    const { found } = this.#known;
    const events = this.#events;
    const listed = found ? `${this.#key} ${score.name} ${this.#store.state.phase}` : '';
    if (listed !== this.#listed) {
      this.#listed = listed;
      const columns = score?.events ? eventColumns(found, score) : [];
      const top = document.createElement('tr');
      top.append(
        ...columns.map(({ title, help, number }) =>
          Object.assign(document.createElement('th'), {
            scope: 'col',
            className: number ? 'number' : '',
            textContent: title,
            title: help ?? '',
          }),
        ),
      );
      if (columns.length)
        top.append(
          Object.assign(document.createElement('th'), { scope: 'col', ariaLabel: 'Link' }),
        );
      this.#part('.events thead').replaceChildren(...(columns.length ? [top] : []));
      this.#rows = events.map((failure, i) => this.#row(columns, failure, score, i));
      this.#part('.events tbody').replaceChildren(...this.#rows.map(({ row }) => row));
      this.#part('.scroll').scrollTop = 0;
      this.#last = -1;
    }
    const phase = score?.phases?.find((g) => g.name === this.#store.state.phase);
    const all = phase ? phase.events : (score?.total ?? 0);
    const left = `${events.length} of ${all} are listed: those among the worst ${score?.events?.length} of all.`;
    this.#part('.rest').textContent = events.length < all ? left : '';
    this.move(this.#store.state.step);
  }

  #row(columns, failure, score, i) {
    const row = document.createElement('tr');
    const go = button('', 'title', (event) => this.#open(failure, event.timeStamp));
    const what = `${score.title} ${withUnit(failure.value, score.unit)}`;
    go.setAttribute(
      'aria-label',
      `Episode ${failure.episode}, step ${failure.step}: ${what}, ${failure.phase}`,
    );
    columns.forEach(({ text, hint, number }, c) => {
      const cell = row.insertCell();
      if (number) cell.className = 'number';
      if (hint) cell.title = hint(failure);
      if (c) cell.textContent = text(failure);
      else cell.append(go);
    });
    go.textContent = columns[0].text(failure);
    const copy = button('', 'quiet link', async () => {
      copy.textContent = (await copyText(new URL(failure.link, location.href).href))
        ? '✓'
        : 'not allowed';
      setTimeout(() => (copy.innerHTML = LINK), TOLD);
    });
    copy.innerHTML = LINK;
    copy.setAttribute(
      'aria-label',
      (copy.title = `Copy link to episode ${failure.episode}, step ${failure.step}`),
    );
    go.tabIndex = copy.tabIndex = i ? -1 : 0;
    row.insertCell().append(copy);
    return { failure, row, button: go };
  }

  #open({ episode, step }, inputTime) {
    this.#store.set({ episode, step, playing: false }, { inputTime });
  }

  /** The listed events of the episode that is shown, on the time line. */
  #mark() {
    if (!this.#trace) return;
    const score = this.#score;
    const { episode } = this.#trace.selection;
    const of = this.#events.filter((failure) => failure.episode === episode);
    this.#timeline.mark(
      of.map((m) => ({
        step: m.step,
        label: `${score.title} ${withUnit(m.value, score.unit)}, ${m.phase}`,
        measure: score.title,
      })),
    );
  }
}

const called = ({ name }) => NAMES[name] ?? name.replaceAll('_', ' ');

/** What the time line has to draw for a measure. */
function drawn(by, trace) {
  if (trace?.components.some(({ name }) => name === by)) return { component: by, track: 'error' };
  return (
    {
      error: { track: 'error' },
      nees: { track: 'nees' },
      ess: { track: 'particles' },
      regret: { weights: 'effective' },
    }[by] ?? {}
  );
}

function said({ state, job, error }) {
  if (state === 'error') return sentence(error);
  if (state === 'active' || state === 'ended') return jobSummary(job);
  if (state === 'waits')
    return 'The run goes on. Its failures are looked for in all its steps once it has ended; that shows here by itself.';
  if (state === 'absent')
    return 'Nobody has looked yet. The filter has to run over all these episodes, so it is done only when asked for.';
  return 'Loading …';
}

function shownUnit(unit) {
  return DISPLAY_UNITS[unit] ?? { unit: UNITS[unit] ?? unit, scale: 1 };
}

function withUnit(value, name) {
  const { unit, scale } = shownUnit(name);
  return `${significant(scale * value)}${unit && ' '}${unit}`;
}

/** @param {api.Failures} found @param {object} score */
function eventColumns(found, score) {
  const { unit } = shownUnit(score.unit);
  const own = shownUnit(score.unit).scale;
  const number = true;
  const columns = [
    { title: 'episode', text: (m) => String(m.episode) },
    {
      title: 'step',
      text: (m) => String(m.step),
      number,
      hint: (m) => `Of steps ${m.first} to ${m.last}, in which it stays high`,
    },
    {
      title: unit ? `${score.title} ${unit}` : score.title,
      text: (m) => significant(own * m.value),
      number,
    },
    {
      title: 'phase',
      text: (m) => m.phase,
      hint: (m) => [m.phase, ...m.other_phases].join(', '),
    },
  ];
  const modalities = found.layers.slice(0, -1);
  found.layers.forEach((layer, i) => {
    if (layer === 'fused' && score.name === 'error') return;
    const name = modalities.length > 1 ? layer : 'error';
    if (modalities.length > 1 || layer === 'fused')
      columns.push({
        title: `${name} cm`,
        text: (m) => fixed(100 * m.error[i], 2),
        number,
        help: 'Distance of its position from the truth',
      });
  });
  if (score.name !== 'nees' && score.events[0]?.nees !== null)
    columns.push({
      title: 'NEES',
      text: (m) => fixed(m.nees),
      number,
      help: 'Normalised squared error: mean 1 where the covariance is right',
    });
  if (modalities.length > 1 && score.events[0]?.effective_weights)
    columns.push({
      title: 'dominant',
      text: (m) => leading(modalities, m.effective_weights),
      help: 'The modality that decides most, with its share as it acted: the mean over the components',
    });
  return columns;
}

function leading(modalities, shares) {
  const most = shares.indexOf(Math.max(...shares));
  return `${modalities[most]} ${percent(shares[most])}`;
}

function button(text, kind, act) {
  const made = Object.assign(document.createElement('button'), {
    type: 'button',
    className: kind,
    textContent: text,
  });
  made.addEventListener('click', act);
  return made;
}
