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

/**
 * Returns the actions on recordings and reports.
 * @param {Catalog} catalog
 * @param {string | undefined} disabledReason set if files cannot be changed
 * @param {FileHandlers} handlers
 */
export function fileActions(catalog, disabledReason, handlers) {
  const { openInRerun, openRun, importRun, rename, remove } = handlers;
  /**
   * @param {{name: string, url: string}} file
   * @param {'recordings' | 'reports'} kind
   */
  const removal = (file, kind) => {
    return { name: 'Delete', key: 'Delete', run: () => remove(file, kind), disabledReason };
  };
  /**
   * Opens the run of a recording: the one in the catalog, or else the one in the file.
   * @param {RecordingEntry} file
   * @param {string | undefined} problem why the file cannot be read
   */
  const runAction = (file, problem) => {
    const run = recordedRun(file);
    if (run) return { run: () => openRun(run) };
    const hasTask = catalog.tasks.some(({ name }) => name === file.task);
    if (problem || file.problem || !hasTask) {
      const reason = file.problem || `This server has no task ${file.task}`;
      return { disabledReason: problem ?? sentence(reason) };
    }
    const hint = `Imported from the file. ${file.why_not}`;
    return { run: () => importRun(file), disabledReason, hint };
  };
  return {
    /**
     * @param {RecordingEntry} file
     * @returns {Action[]}
     */
    forRecording(file) {
      const unread = file.application ? undefined : sentence(file.problem);
      const problem = file.reading ? 'The server is still reading this file.' : unread;
      const open = { run: () => openInRerun(file), disabledReason: problem };
      return [
        { name: 'Open in Rerun', key: 'Enter', ...open },
        { name: 'Open run in dashboard', ...runAction(file, problem) },
        { name: 'Rename', key: 'F2', run: () => rename(file), disabledReason },
        { name: `Download, ${formatBytes(file.bytes)}`, href: file.url, download: file.name },
        removal(file, 'recordings'),
      ];
    },

    /**
     * @param {ReportEntry} file
     * @returns {Action[]}
     */
    forReport(file) {
      const { run, problem } = reportedRun(catalog, file);
      const open = { run: () => run && openRun(run), disabledReason: problem };
      const pdf = file.pdf && { href: file.pdf, download: `${file.name}.pdf` };
      return [
        { name: 'Open', key: 'Enter', href: `${file.url}?inline=true`, newWindow: true },
        { name: 'Open run in dashboard', ...open },
        { name: 'Download HTML', href: file.url, download: `${file.name}.html` },
        ...(pdf ? [{ name: 'Download PDF', ...pdf }] : []),
        removal(file, 'reports'),
      ];
    },
  };
}
