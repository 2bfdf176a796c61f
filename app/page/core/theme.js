/** Light or dark theme. */

const STORAGE_KEY = 'beliefscope.theme';

/** Follows the system until the user chooses a theme; `before_paint.js` restores it. */
export class Theme {
  #media = matchMedia('(prefers-color-scheme: dark)');
  #changed;

  /** @param {(dark: boolean) => void} changed */
  constructor(changed) {
    this.#changed = changed;
    this.#media.addEventListener('change', () => changed(this.dark));
  }

  get dark() {
    const { theme } = document.documentElement.dataset;
    return theme ? theme === 'dark' : this.#media.matches;
  }

  toggle() {
    const theme = this.dark ? 'light' : 'dark';
    document.documentElement.dataset.theme = theme;
    localStorage.setItem(STORAGE_KEY, theme);
    this.#changed(this.dark);
  }
}
