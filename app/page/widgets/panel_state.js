/** What a panel says while it has nothing to show: loading, empty, or an error. Its place stays the same. */

/**
 * @param {HTMLElement} body of a panel, with a `.note` inside
 * @param {'ready' | 'loading' | 'empty' | 'error'} state @param {string} [text] @param {number | null} [share] done, 0..1
 */
export function say(body, state, text = '', share = null) {
  body.dataset.state = state;
  body.setAttribute('aria-busy', String(state === 'loading'));
  const note = body.querySelector('.note');
  note.textContent = state === 'ready' ? '' : text;
  note.style.setProperty('--done', share === null ? '' : String(share));
  note.classList.toggle('measured', state === 'loading' && share !== null);
}

/** Lines across the top of the page: what went wrong, until it is put right or put away. */
export class Messages {
  #host;

  /** @param {HTMLElement} host */
  constructor(host) {
    this.#host = host;
  }

  /** @param {string} key what it is about: a newer line takes the place of the older; an empty one ends it. */
  say(key, text) {
    const before = this.#host.querySelector(`[data-key="${key}"]`);
    if (!text) {
      before?.remove();
      return;
    }
    const line = before ?? document.createElement('p');
    if (!before) {
      line.dataset.key = key;
      const close = document.createElement('button');
      [close.type, close.textContent] = ['button', '×'];
      close.setAttribute('aria-label', 'Dismiss');
      close.addEventListener('click', () => line.remove());
      line.append(document.createElement('span'), close);
      this.#host.append(line);
    }
    if (line.firstChild.textContent !== text) line.firstChild.textContent = text;
  }
}
