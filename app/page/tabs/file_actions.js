/** Actions on recordings and reports, for the menus of their tables. */

/** @import { Catalog, RecordingEntry, ReportEntry } from '../types/server.js' */
/** @import { Action } from '../widgets/file_table.js' */
/** @import { Run } from './recorded_run.js' */

import { formatBytes, sentence } from '../core/units.js';
import { recordedRun, reportedRun } from './recorded_run.js';

/**
 * @typedef {object} FileHandlers
 * @property {(file: RecordingEntry) => void} openInRerun
 * @property {(run: Run) => void} openRun
 * @property {(file: RecordingEntry) => void} importRun
 * @property {(file: RecordingEntry) => void} rename
 * @property {(file: {name: string, url: string}, kind: 'recordings' | 'reports') => void} remove
 */

export class FileActions {
  #catalog;
  #disabledReason;
  #handlers;

  /**
   * @param {Catalog} catalog
   * @param {string | undefined} disabledReason set if files cannot be changed
   * @param {FileHandlers} handlers
   */
  constructor(catalog, disabledReason, handlers) {
    this.#catalog = catalog;
    this.#disabledReason = disabledReason;
    this.#handlers = handlers;
  }

  /**
   * @param {RecordingEntry} file
   * @returns {Action[]}
   */
  forRecording(file) {
    const { openInRerun, rename } = this.#handlers;
    const disabledReason = this.#disabledReason;
    const problem = file.reading
      ? 'The server is still reading this file.'
      : file.application
        ? undefined
        : sentence(file.problem);
    return [
      {
        name: 'Open in Rerun',
        key: 'Enter',
        run: () => openInRerun(file),
        disabledReason: problem,
      },
      { name: 'Open run in dashboard', ...this.#runAction(file, problem) },
      { name: 'Rename', key: 'F2', run: () => rename(file), disabledReason },
      { name: `Download, ${formatBytes(file.bytes)}`, href: file.url, download: file.name },
      this.#removal(file, 'recordings'),
    ];
  }

  /**
   * @param {ReportEntry} file
   * @returns {Action[]}
   */
  forReport(file) {
    const { run, problem } = reportedRun(this.#catalog, file);
    const pdf = file.pdf && { name: 'Download PDF', href: file.pdf, download: `${file.name}.pdf` };
    return [
      { name: 'Open', key: 'Enter', href: `${file.url}?inline=true`, newWindow: true },
      {
        name: 'Open run in dashboard',
        run: () => run && this.#handlers.openRun(run),
        disabledReason: problem,
      },
      { name: 'Download HTML', href: file.url, download: `${file.name}.html` },
      ...(pdf ? [pdf] : []),
      this.#removal(file, 'reports'),
    ];
  }

  /**
   * Opens the run of a recording: the one in the catalog, or else the one in the file.
   * @param {RecordingEntry} file
   * @param {string | undefined} problem why the file cannot be read
   */
  #runAction(file, problem) {
    const run = recordedRun(file);
    if (run) return { run: () => this.#handlers.openRun(run) };
    const hasTask = this.#catalog.tasks.some(({ name }) => name === file.task);
    if (problem || file.problem || !hasTask) {
      const reason = file.problem || `This server has no task ${file.task}`;
      return { disabledReason: problem ?? sentence(reason) };
    }
    return {
      run: () => this.#handlers.importRun(file),
      disabledReason: this.#disabledReason,
      hint: `Imported from the file. ${file.why_not}`,
    };
  }

  /**
   * @param {{name: string, url: string}} file
   * @param {'recordings' | 'reports'} kind
   * @returns {Action}
   */
  #removal(file, kind) {
    return {
      name: 'Delete',
      key: 'Delete',
      run: () => this.#handlers.remove(file, kind),
      disabledReason: this.#disabledReason,
    };
  }
}
