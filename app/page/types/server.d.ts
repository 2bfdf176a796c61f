/** JSON of the server's interface: the generated types, and the types that the page extends or makes more precise. */

import type * as api from './api.js';

export type * from './api.js';

/** A row of a study's table. */
export type StudyRow = api.Row;

export interface Component extends api.Component {
  unit: 'm' | 'rad';
}

/** An episode. The episode of a live run has a label in place of its properties. */
export type EpisodeSummary = Pick<api.EpisodeSummary, 'index' | 'steps'> &
  Partial<api.EpisodeSummary> & { label?: string };

/** A filter. live: name of the data set of the only run that has it. */
export type Filter = Pick<api.FilterInfo, 'name' | 'kind'> &
  Partial<api.FilterInfo> & { live?: string };

export interface DataSet extends Omit<api.DataInfo, 'episodes'> {
  episodes: EpisodeSummary[];
  live?: api.ListedLiveRun;
}

export interface Task extends Omit<api.TaskInfo, 'components' | 'filters' | 'data'> {
  components: Component[];
  filters: Filter[];
  data: DataSet[];
}

export interface Catalog extends Omit<api.Catalog, 'tasks'> {
  tasks: Task[];
}

export interface LiveList extends Omit<api.LiveList, 'tasks'> {
  tasks: Task[];
}

/** Names of a run. against: differences of the comparison run, empty for the run itself. */
export interface Selection {
  task: string;
  filter: string;
  data: string;
  episode: number;
  faults: string;
  against?: string;
}

export interface TraceHeader extends Omit<api.TraceHeader, 'components' | 'settings'> {
  components: Component[];
  settings: { particles?: number; edits?: { from: number; to: number }[]; standalone?: string };
}

/** A live run of a displayed trace. Its state is `gone` if the server no longer has it. */
export interface LiveRun extends Omit<api.LiveRun, 'state'> {
  state: string;
}

export type Job = Required<api.Job>;

export type JobWithLog = Required<api.JobWithLog>;

/** preliminary: result that is available before the job is done. */
export interface JobReply<T = never> {
  job: Job | null;
  preliminary?: T;
}

export interface StartedJob {
  job: Job;
}

/** Settings of fine-tuning. mix: data slices to train on. train: presets and modules; events: episodes and steps. */
export interface FineTuneSettings {
  train: string[];
  clean_weight: number;
  steps: number;
  length: number;
  rate: number;
  l2_sp: number;
  seed: number;
  mix: { slice: Pick<api.SliceInfo, 'name'>; share: number }[];
  events: string[];
  success?: string | null;
}

export interface Weakness extends Omit<api.Weakness, 'settings'> {
  settings: FineTuneSettings;
}

export interface FineTuneRunSummary extends FineTuneRunInfo {
  progress: FineTuneProgress | null;
  success: api.Success | null;
}

export interface FineTuneRunInfo extends Omit<api.FineTuneRunInfo, 'settings' | 'job'> {
  settings: FineTuneSettings;
  job: Job | null;
}

export interface FineTuneOffer extends Omit<api.FineTuneOffer, 'settings' | 'runs'> {
  settings: FineTuneSettings;
  runs: FineTuneRunSummary[];
}

export interface FineTuneProgress extends Omit<api.FineTuneProgress, 'validations'> {
  validations: (Omit<api.Validation, 'slices'> & {
    slices: Record<string, { rmse: Record<string, number | null> }>;
  })[];
}

export interface FineTuneDetails extends FineTuneRunInfo {
  progress: FineTuneProgress | null;
  result: api.FineTuneResult | null;
}
