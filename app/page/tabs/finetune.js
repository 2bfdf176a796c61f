/** Fine-tuning: what of the filter is trained, on what, the run as it goes, and what it mended and broke. */

import * as api from '../data/api.js';
import { Descent } from './lineage.js';
import { Figures } from '../widgets/figures.js';
import { jobSummary, isActive } from '../widgets/jobs.js';
import { ModuleTree } from './module_tree.js';
import { setPanelState } from '../widgets/panel_state.js';
import { faultPicker } from '../widgets/fault_dialog.js';
import { permalink } from '../core/state.js';
import { fixed, sentence, displayName } from '../core/units.js';

const OWN = 'own'; // a choice of parts, or a slice, that has no name
const DEFAULT = { preset: 'haptics-only', slice: 'blackout 0.8' }; // of a first run, where the filter has them
const STEPS = [
  ['', 'all steps'],
  ['yes', 'in contact'],
  ['no', 'out of contact'],
];
const PLACES = {
  saved: 'The child is on the shelf, beside its parent.',
  default: 'The child is on the shelf, and what this server shows first.',
};
const NUMBERS = [
  [
    'clean_weight',
    'Share of nominal data',
    0.05,
    'Of the loss: data as they are hold the rest in place',
  ],
  ['steps', 'Training steps', 1, 'Of the optimiser, at most'],
  ['length', 'Window, steps', 1, 'Steps of each piece of a trajectory that is learned from'],
  ['rate', 'Learning rate', 'any', 'Of Adam'],
  ['l2_sp', 'Pull to the parent', 'any', 'How strongly weights are drawn back to the parent’s'],
  ['seed', 'Seed', 1, 'Of all that is drawn'],
];

const FORM = `
  <form novalidate aria-label="Fine-tuning">
    <div class="row"><label>Train <select name="preset"></select></label> <span class="count"></span></div>
    <ul class="tree" aria-label="Modules"></ul>
    <div class="row">
      <label title="A part of what the filter meets, by its name; what it is stands beside it">Learn from <select name="slice"></select></label>
      <label>Sensors <select name="faults"></select></label>
      <label title="Which steps of an episode count">Steps <select name="contact"></select></label>
      <label title="What the filter is given: all, or one alone">Modalities <select name="only"></select></label>
    </div>
    <div class="row numbers"></div>
    <div class="row"><label title="Of the slice, only these steps are learned from: episodes, and steps of them. All training episodes where it is empty.">Only episodes, steps <input name="moments" placeholder="9, 31:20-60" autocomplete="off" spellcheck="false"></label></div>
    <div class="row"><button class="text start">Fine-tune</button> <label class="past" hidden>Runs so far <select name="past"></select></label></div>
    <p class="error" role="alert"></p>
    <section class="descent"></section>
  </form>
  <article hidden tabindex="-1">
    <div class="row"><button type="button" class="text quiet back">‹ New run</button><h3></h3></div>
    <p class="verdict" aria-live="polite"></p>
    <div class="row doing"><progress aria-label="Progress of the fine-tuning" max="1"></progress><button type="button" class="text act">Pause</button></div>
    <div class="row decide"></div>
    <div class="figures live"></div>
    <section class="moments" hidden><h4>Moments that got worse (cm)</h4><ol></ol></section>
    <div class="figures report"></div>
  </article>
  <p class="note"></p>`;

export class Finetune {
  #host;
  #store;
  #jobs;
  #catalog;
  #tree;
  #descent;
  #live;
  #report;
  #showFaults;
  #offer = null;
  #run = null;
  #heard = '';
  #faults = '';
  #open = false;
  #loaded = '';
  #loading = new AbortController();

  /**
   * @param {HTMLElement} host @param {import('../data/api.js').Catalog} catalog @param {import('../core/state.js').Store} store
   * @param {import('../widgets/jobs.js').Jobs} jobs @param {import('../widgets/fault_dialog.js').FaultDialog} sheet
   */
  constructor(host, catalog, store, jobs, sheet) {
    [this.#host, this.#catalog, this.#store, this.#jobs] = [host, catalog, store, jobs];
    host.innerHTML = FORM;
    this.#tree = new ModuleTree(
      this.#part('.tree'),
      () => ((this.#field('preset').value = OWN), this.#count()),
    );
    this.#descent = new Descent(this.#part('.descent'), store);
    this.#live = new Figures(this.#part('.live'), store);
    this.#report = new Figures(this.#part('.report'), store);
    this.#part('.numbers').append(...NUMBERS.map(number));
    fill(this.#field('contact'), STEPS);
    this.#showFaults = faultPicker(this.#field('faults'), sheet, {
      none: 'as recorded',
      chosen: () => this.#faults,
      choose: (faults) => ((this.#faults = faults), (this.#field('slice').value = OWN)),
      check: (faults) => api.checkSelection({ ...store.state, faults, against: '' }),
    });
    for (const name of ['contact', 'only'])
      this.#field(name).addEventListener('change', () => (this.#field('slice').value = OWN));
    this.#field('preset').addEventListener('change', () => this.#takePreset());
    this.#field('slice').addEventListener('change', () => this.#takeSlice());
    this.#field('past').addEventListener('change', () =>
      store.set({ run: this.#field('past').value }),
    );
    this.#part('.back').addEventListener(
      'click',
      () => (store.set({ run: '' }), store.flush(), this.#field('preset').focus()),
    );
    this.#part('.act').addEventListener('click', () =>
      isActive(this.#run.job)
        ? jobs.cancel(this.#run.job.id)
        : this.#start(this.#run.settings, this.#run),
    );
    this.#part('form').addEventListener(
      'submit',
      (event) => (event.preventDefault(), this.#start(this.#settings())),
    );
    jobs.listen((list) => this.#hear(list));
  }

  /** Whether the panel can be seen; nothing is asked for before. */
  set open(open) {
    this.#open = open;
    if (open) this.load();
  }

  redraw() {
    this.#live.redraw();
    this.#report.redraw();
  }

  /** Another task, filter or run: asks what can be done, and how the run is. */
  async load() {
    if (!this.#open) return;
    const { task, filter, run } = this.#store.state;
    const key = JSON.stringify([task, filter]);
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    try {
      if (key !== this.#loaded) {
        setPanelState(this.#host, 'loading', 'Looking into the filter …');
        this.#offer = await api.finetuneOptions(this.#store.state, signal);
        this.#loaded = key;
        this.#showOffer();
        await this.#descent.load(signal);
      }
      this.#run = run ? await api.finetuneRun(run, signal) : null;
      this.#show();
      setPanelState(
        this.#host,
        this.#offer.why_not && !run ? 'empty' : 'ready',
        this.#offer.why_not && sentence(this.#offer.why_not),
      );
    } catch (error) {
      if (error.name === 'AbortError') return;
      if (!(error instanceof api.ServerError)) console.error(error);
      setPanelState(this.#host, 'error', error.message);
    }
  }

  #part(selector) {
    return this.#host.querySelector(selector);
  }

  #field(name) {
    return this.#part('form').elements.namedItem(name); // `length` is a property of the elements
  }

  get #all() {
    return this.#offer.presets.find(({ name }) => name === 'all')?.trains ?? [];
  }

  /** The form for another filter, filled in for a run of one click. */
  #showOffer() {
    const { modules, presets, slices, settings, runs } = this.#offer;
    const task = this.#catalog.tasks.find(({ name }) => name === this.#store.state.task);
    this.#tree.show(modules, this.#all);
    const known = (list, name) => (list.some((one) => one.name === name) ? name : list[0]?.name);
    fill(this.#field('preset'), [
      ...presets.map(({ name }) => [name, displayName(name).replace('-only', ' only')]),
      [OWN, 'as ticked'],
    ]);
    this.#field('preset').value = known(presets, DEFAULT.preset) ?? OWN;
    fill(this.#field('only'), [
      ['', 'all'],
      ...slices
        .filter((s) => s.only.length)
        .map((s) => [s.only.join('+'), `only ${s.only.join(' + ')}`]),
    ]);
    fill(this.#field('slice'), [
      ...slices.map(({ name }) => [name, name]),
      ['', 'nothing but nominal data'],
      [OWN, 'as chosen here'],
    ]);
    this.#field('slice').value = known(slices, DEFAULT.slice) ?? '';
    this.#showFaults(task.fault_presets);
    for (const [name] of NUMBERS) this.#field(name).value = settings[name];
    const past = this.#part('.past');
    past.hidden = !runs.length;
    fill(this.#field('past'), [
      ['', 'choose …'],
      ...runs.map((run) => [
        run.run,
        `${run.filter}: ${learned(run)}${run.finetuned ? ` → ${run.finetuned}` : ''}`,
      ]),
    ]);
    this.#takePreset();
    this.#takeSlice();
  }

  #takePreset() {
    const preset = this.#offer.presets.find(({ name }) => name === this.#field('preset').value);
    if (preset) this.#tree.choose(preset.trains);
    this.#count();
  }

  #count() {
    const [trained, all] = this.#tree.count;
    this.#part('.count').textContent =
      `${trained.toLocaleString('en')} of ${all.toLocaleString('en')} parameters; the rest is frozen`;
  }

  /** Shows what a slice with a name is. */
  #takeSlice() {
    const name = this.#field('slice').value;
    if (name === OWN) return;
    const slice = this.#offer.slices.find((one) => one.name === name);
    const faults = slice?.text.match(/faults=(.*?)(?=$|:contact=|:only=)/)?.[1] ?? '';
    this.#faults = faults;
    this.#showFaults(
      this.#catalog.tasks.find((task) => task.name === this.#store.state.task).fault_presets,
    );
    this.#field('contact').value =
      slice?.contact === true ? 'yes' : slice?.contact === false ? 'no' : '';
    this.#field('only').value = slice?.only.join('+') ?? '';
  }

  /** What the form asks for, as the server takes it. */
  #settings() {
    const value = (name) => this.#field(name).value;
    const preset = value('preset');
    const settings = Object.fromEntries(NUMBERS.map(([name]) => [name, Number(value(name))]));
    settings.train = preset === OWN ? this.#tree.trained : [preset];
    settings.events = value('moments')
      .split(/[\s,]+/)
      .filter(Boolean);
    const [contact, only] = [value('contact'), value('only')];
    const named = this.#offer.slices.find((one) => one.name === value('slice'));
    if (named) settings.mix = [{ slice: plain(named), share: 1 }];
    else if (value('slice') === OWN && (this.#faults || contact || only))
      settings.mix = [{ slice: own(this.#faults, contact, only), share: 1 }];
    return settings;
  }

  async #start(settings, of = this.#store.state) {
    const wrong = this.#part('.error');
    wrong.textContent = '';
    if (!settings.train.length)
      return (wrong.textContent = 'Nothing is ticked: there is nothing to train.');
    try {
      const run = await api.startFinetune(of, settings);
      this.#loaded = ''; // it is among the runs now
      this.#store.set({ run: run.run });
      this.#jobs.refresh();
      this.load();
    } catch (error) {
      wrong.textContent = error.message;
    }
  }

  /** Jobs have changed: how the run is now. */
  #hear(list) {
    const job = list.find(({ id }) => id === this.#run?.job?.id);
    const heard = JSON.stringify(job ?? null);
    if (!this.#open || !this.#run || heard === this.#heard) return;
    this.#heard = heard;
    this.load();
  }

  /** The form, or the run. */
  #show() {
    const run = this.#run;
    this.#part('form').hidden = Boolean(run);
    this.#part('article').hidden = !run;
    if (!run) return;
    const { job, result: found, progress } = run;
    this.#part('h3').textContent =
      `${run.filter}: ${run.settings.train.map((name) => name.replace('-only', '')).join(', ') || 'all'} on ${learned(run)}`;
    this.#part('.verdict').textContent = found
      ? found.comparison.verdict
      : job
        ? said(job)
        : 'Its job is forgotten. It goes on where it stood.';
    this.#part('article').dataset.state = found
      ? 'ready'
      : job && (isActive(job) || job.state === 'cancelled')
        ? 'working'
        : 'ended';
    const [bar, act] = this.#part('.doing').children;
    this.#part('.doing').hidden = Boolean(found);
    [bar.hidden, bar.value] = [!isActive(job), job?.progress ?? 0];
    act.textContent = isActive(job) ? 'Pause' : 'Go on';
    act.title = isActive(job)
      ? 'It goes on from its last look at the validation episodes'
      : '';
    this.#decisions();
    const mapped = this.#catalog.tasks.find(({ name }) => name === run.task);
    this.#live.show(progress && curvesOf(progress, mapped), null);
    this.#report.show(found?.comparison ?? null, null);
    this.#moments(found?.events ?? []);
  }

  #decisions() {
    const { finetuned: child, saved_as: place, result: found } = this.#run;
    const host = this.#part('.decide');
    host.hidden = !found;
    if (!found) return;
    const acts = [
      [
        'promote',
        'Promote to default',
        'What this server shows first from now on',
        place !== 'default',
      ],
      ['save', 'Save', 'On the shelf beside its parent', place !== 'saved'],
      ['discard', 'Discard', 'Off the shelf; the parent is as it was', place !== null],
    ];
    const line = document.createElement('span');
    line.textContent =
      PLACES[place] ??
      `${child}: after ${found.finetuned.best_step} of ${found.finetuned.steps} steps, ${fixed(found.finetuned.seconds, 0)} s. The parent is untouched.`;
    host.replaceChildren(
      ...acts.map(([act, name, title, able]) => {
        const button = document.createElement('button');
        Object.assign(button, {
          type: 'button',
          className: 'text',
          textContent: name,
          title,
          disabled: !able,
        });
        button.addEventListener('click', () => this.#decide(act));
        return button;
      }),
      line,
    );
  }

  /** The shelf is another one then, so the page begins anew, at the child or at its parent. */
  async #decide(act, to = null) {
    try {
      const { run, filter, finetuned: child } = this.#run;
      await api.decideFinetune(run, act);
      const { state } = this.#store;
      const shown =
        act === 'promote'
          ? child
          : state.filter === child && act === 'discard'
            ? filter
            : state.filter;
      location.assign(to ?? `/${permalink({ ...state, filter: shown })}`);
    } catch (error) {
      this.#part('.verdict').textContent = error.message;
    }
  }

  #moments(moments) {
    const host = this.#part('.moments');
    host.hidden = !moments.length;
    host.querySelector('ol').replaceChildren(
      ...moments.map((m) => {
        const line = document.createElement('li');
        const link = Object.assign(document.createElement('a'), {
          href: `/${m.link}`,
          textContent: `episode ${m.episode}, step ${m.step}`,
        });
        link.title = `Opens it on the child, with ${m.only.length ? `${m.only.join(' + ')} alone` : 'its parent'} beside it`;
        link.addEventListener('click', (event) => {
          if (this.#run.saved_as) return;
          event.preventDefault();
          this.#decide('save', link.href); // a link opens what is on the shelf
        });
        line.append(
          link,
          ` ${m.slice}${m.contact ? ', in contact' : ''}: ${fixed(100 * m.before, 2)} → ${fixed(100 * m.after, 2)}`,
        );
        return line;
      }),
    );
  }
}

/** The loss of each step, and each slice's error on the validation episodes, as plots. */
function curvesOf({ losses, validations }, task) {
  const places = validations.length ? Object.keys(validations[0].slices) : [];
  const error = (name) => ({
    name,
    layer: '',
    x: validations.map((l) => l.step),
    y: validations.map((l) => l.slices[name].rmse.position_cm),
  });
  const plots = [
    {
      title: 'Loss',
      x_label: 'step',
      y_label: '',
      kind: 'line',
      diagonal: false,
      lines: [
        { name: '', layer: '', x: losses.map(([step]) => step), y: losses.map(([, loss]) => loss) },
      ],
    },
  ];
  const of = displayName(task.map.x).replace(/(^| )x$/, '') || 'position';
  plots.push({
    title: 'Validation',
    x_label: 'step',
    y_label: `RMSE of the ${of} (cm)`,
    kind: 'line',
    diagonal: false,
    lines: places.map(error),
  });
  return {
    curves: [],
    bands: {},
    tables: [],
    images: [],
    plots: plots.filter(({ lines }) => lines.length && lines[0].x.length),
  };
}

const said = (job) =>
  job.state === 'cancelled'
    ? 'Paused. It goes on from its last look at the validation episodes.'
    : jobSummary(job);

const learned = ({ settings }) =>
  settings.mix.map(({ slice }) => slice.name).join(' and ') || 'nominal data';

/** A slice as the server takes it. */
const plain = ({ name, faults, contact, only }) => ({ name, faults, contact, only });

/** A slice's text, named after what it is. */
function own(faults, contact, only) {
  const name = [
    faults.replace(/[:=]/g, ' ') || 'whole',
    { yes: 'in contact', no: 'out of contact' }[contact],
    only && `${only} alone`,
  ]
    .filter(Boolean)
    .join(', ');
  return [name, `faults=${faults}`, contact && `contact=${contact}`, only && `only=${only}`]
    .filter(Boolean)
    .join(':');
}

function number([name, text, step, title]) {
  const label = Object.assign(document.createElement('label'), { title, textContent: `${text} ` });
  label.append(
    Object.assign(document.createElement('input'), { type: 'number', name, step, min: 0 }),
  );
  return label;
}

function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
}
