/** Files that are being added: sent one after the other, each with how far it is, a way to stop it, and what went wrong. */

import { formatBytes, percent, sentence } from '../core/units.js';

export class Adding {
  #host;
  #done;
  #last = Promise.resolve();

  /** @param {HTMLElement} host a list @param {(added: object) => void} done called with each recording that was added */
  constructor(host, done) {
    [this.#host, this.#done] = [host, done];
  }

  /** @param {File[]} files @param {(name: string) => string} free a name like this one that nobody has @param {number} largest bytes */
  add(files, free, largest) {
    for (const file of files) this.#last = this.#one(file, free, largest, this.#last);
  }

  async #one(file, free, largest, before) {
    const line = document.createElement('li');
    line.innerHTML =
      '<span></span><progress max="1" value="0"></progress><button type="button" class="text quiet">Cancel</button>';
    const [text, bar, button] = line.children;
    bar.ariaLabel = `Progress of ${file.name}`;
    text.textContent = `${file.name}, ${formatBytes(file.size)}: waits`;
    this.#host.append(line);
    const request = new XMLHttpRequest();
    let stopped = false;
    button.addEventListener('click', () => ((stopped = true), request.abort(), line.remove()));
    await before;
    if (stopped) return;
    try {
      if (file.size > largest)
        throw new Error(
          `it has ${formatBytes(file.size)}, and no more than ${formatBytes(largest)} are taken here`,
        );
      const added = await send(request, file, free(file.name), (share) => {
        bar.value = share;
        text.textContent = `${file.name}: ${share < 1 ? percent(share) : 'is looked into'}`;
      });
      line.remove();
      this.#done(added);
    } catch (error) {
      line.dataset.state = 'error';
      text.textContent = `${file.name} was not added: ${sentence(error.message)}`;
      bar.remove();
      [button.textContent, button.ariaLabel] = ['×', 'Dismiss'];
    }
  }
}

/** Sends a file; only an XMLHttpRequest tells how much of it has gone. */
function send(request, file, name, progress) {
  return new Promise((resolve, reject) => {
    request.open('PUT', `/api/recordings/${encodeURIComponent(name)}`);
    request.responseType = 'json';
    request.upload.addEventListener('progress', ({ loaded, total }) =>
      progress(total ? loaded / total : 1),
    );
    request.addEventListener('load', () => {
      if (request.status === 201) resolve(request.response);
      else reject(new Error(request.response?.error ?? `the server answered ${request.status}`));
    });
    request.addEventListener('error', () => reject(new Error('the server does not answer')));
    request.send(file);
  });
}
