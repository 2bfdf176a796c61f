import assert from 'node:assert/strict';
import { test } from 'node:test';

/** Requests that were sent, the newest last. @type {Request[]} */
const sent = [];

class Request extends EventTarget {
  upload = new EventTarget();
  status = 0;
  address = '';

  /** @param {string} _ @param {string} address */
  open(_, address) {
    this.address = decodeURIComponent(address);
  }

  send() {
    sent.push(this);
  }

  abort() {
    this.dispatchEvent(new Event('abort'));
  }
}

/** An element that is only appended and clicked. */
class Node extends EventTarget {
  dataset = {};
  /** @type {any[]} */
  children = [];

  /** @param {any[]} children */
  append(...children) {
    this.children.push(...children);
  }

  remove() {}
}

Object.assign(globalThis, {
  XMLHttpRequest: Request,
  document: { createElement: () => new Node() },
});
const { unusedName, Uploads } = await import('../../app/page/widgets/upload.js');
const turn = () => new Promise((resolve) => setTimeout(resolve));

test('after a cancelled upload the next one starts', async () => {
  const list = new Node();
  const uploads = new Uploads(/** @type {any} */ (list), () => {});
  const files = ['a.rrd', 'b.rrd'].map((name) => ({ name, size: 1 }));
  uploads.add(/** @type {any} */ (files), new Set(), 10);
  await turn();
  const cancel = list.children[0].children[2];
  cancel.dispatchEvent(new Event('click'));
  await turn();
  assert.deepEqual(
    sent.map(({ address }) => address),
    ['/api/recordings/a.rrd', '/api/recordings/b.rrd'],
  );
});

test('a name in use gets a number, also in another normal form or while it is uploaded', async () => {
  assert.equal(unusedName('run.rrd', new Set(['run.rrd', 'run-2.rrd'])), 'run-3.rrd');
  assert.equal(unusedName('e\u0301.rrd', new Set(['\u00e9.rrd'])), '\u00e9-2.rrd');
  assert.equal(unusedName('run.RRD', new Set()), 'run.rrd');
  const uploads = new Uploads(/** @type {any} */ (new Node()), () => {});
  const file = /** @type {any} */ ({ name: 'c.rrd', size: 1 });
  uploads.add([file], new Set(), 10);
  uploads.add([file], new Set(), 10);
  await turn();
  sent.at(-1)?.abort();
  await turn();
  assert.equal(sent.at(-1)?.address, '/api/recordings/c-2.rrd');
});
