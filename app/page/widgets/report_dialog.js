/** "Report": a sheet of what a report of the shown run is to hold; Enter has it made as it is. */

const WHOLE = /^\d+$/;
const BODY = `
  <form aria-label="Report" novalidate>
    <h2>Report of this run</h2>
    <p class="about">One page that opens offline, with its figures, tables and numbers beside it.</p>
    <fieldset>
      <legend>Moments shown with scene, picture, maps and numbers</legend>
      <label><input type="radio" name="which" value="worst" checked> the three with the largest position error</label>
      <label><input type="radio" name="which" value="these"> these steps <input type="text" name="steps" aria-label="Steps" placeholder="12, 40" autocomplete="off"></label>
      <p class="offered"></p>
    </fieldset>
    <label><input type="checkbox" name="every"> <span>slow diagnostics as well: likelihood maps, saliency, Shapley values</span></label>
    <label><input type="checkbox" name="pdf"> <span>print it as PDF as well</span></label>
    <label class="title">Title <input type="text" name="title" maxlength="200" autocomplete="off"></label>
    <p class="wrong" role="alert"></p>
    <button class="text make" autofocus>Make the report</button>
  </form>`;

export class ReportSheet {
  #sheet = Object.assign(document.createElement('div'), {
    id: 'report-sheet',
    popover: 'auto',
    innerHTML: BODY,
  });
  #form;
  #make;
  #trace = null;

  /**
   * @param {HTMLButtonElement} button that opens it @param {() => {step: number, pinned: {maps: {step: number}, selection: object} | null}} now the moments to offer
   * @param {(trace: import('../data/trace.js').Trace, wanted: import('../data/api.js').ReportOptions) => Promise<void>} make has it made; rejects with what is wrong
   */
  constructor(button, now, make) {
    this.#make = make;
    this.#form = this.#sheet.querySelector('form');
    this.#sheet.setAttribute('role', 'dialog');
    this.#sheet.setAttribute('aria-label', 'Report of this run');
    button.after(this.#sheet);
    button.popoverTargetElement = this.#sheet;
    button.setAttribute('aria-haspopup', 'dialog');
    const { steps, which } = this.#form.elements;
    steps.addEventListener('input', () => (which.value = steps.value.trim() ? 'these' : 'worst'));
    // Who chose with the mouse makes it with Enter, too.
    this.#form.addEventListener(
      'change',
      ({ target }) => target.matches(':focus-visible') || this.#form.querySelector('.make').focus(),
    );
    this.#form.addEventListener('submit', (event) => (event.preventDefault(), this.#submit()));
    this.#sheet.addEventListener('beforetoggle', ({ newState }) => {
      if (newState !== 'open') return;
      const { bottom, right } = button.getBoundingClientRect();
      [this.#sheet.style.top, this.#sheet.style.right] = [
        `${bottom + 5}px`,
        `${Math.max(6, innerWidth - right - 60)}px`,
      ];
      this.#say('');
      this.#offer(now());
    });
  }

  /** @param {import('../data/trace.js').Trace} trace another run: steps that were chosen are of the one before */
  show(trace) {
    this.#trace = trace;
    const { steps, which, title } = this.#form.elements;
    [steps.value, which.value] = ['', 'worst'];
    title.placeholder = `${trace.header.filter} on ${trace.selection.task}`;
  }

  /** Buttons that put this moment, or the pinned one, among the steps. */
  #offer({ step, pinned }) {
    const same =
      pinned &&
      Object.entries(this.#trace?.selection ?? {}).every(
        ([key, value]) => pinned.selection[key] === value,
      );
    const offered = [
      [`this one, ${step}`, step],
      ...(same && pinned.maps.step !== step
        ? [[`the pinned one, ${pinned.maps.step}`, pinned.maps.step]]
        : []),
    ];
    this.#form.querySelector('.offered').replaceChildren(
      'Add ',
      ...offered.map(([textContent, one]) => {
        const button = Object.assign(document.createElement('button'), {
          type: 'button',
          className: 'text quiet',
          textContent,
        });
        button.addEventListener('click', () => this.#add(one));
        return button;
      }),
    );
  }

  #add(step) {
    const { steps, which } = this.#form.elements;
    const there = parts(steps.value);
    if (!there.includes(String(step))) steps.value = [...there, step].join(', ');
    which.value = 'these';
  }

  async #submit() {
    const { which, steps, every, pdf, title } = this.#form.elements;
    const asked = which.value === 'these' ? parts(steps.value) : [];
    const last = (this.#trace?.steps ?? 0) - 1;
    const wrong = asked.find((step) => !WHOLE.test(step) || Number(step) > last);
    if (!this.#trace) return this.#say('The run is not there yet.');
    if (wrong !== undefined)
      return this.#say(`${wrong} is no step of this run: it has steps 0 to ${last}.`);
    if (which.value === 'these' && !asked.length)
      return this.#say('Give one step or more, such as 12, 40.');
    try {
      await this.#make(this.#trace, {
        events: asked.map(Number),
        slow: every.checked,
        pdf: pdf.checked,
        title: title.value.trim(),
      });
      this.#sheet.hidePopover();
    } catch (error) {
      this.#say(error.message);
    }
  }

  #say(problem) {
    this.#form.querySelector('.wrong').textContent = problem;
  }
}

/** What stands between commas or spaces. */
const parts = (text) => text.split(/[\s,]+/).filter(Boolean);
