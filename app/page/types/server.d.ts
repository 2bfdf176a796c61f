/** JSON of the server's interface (docs/api.md). */

export interface Component {
  name: string;
  unit: 'm' | 'rad';
}

export interface EpisodeSummary {
  index: number;
  steps: number;
  policy?: string;
  split?: string;
  seed?: number;
  contact_fraction?: number;
  /** Text in place of the properties, for a live run. */
  label?: string;
}

export interface Filter {
  name: string;
  kind: string;
  checkpoint_hash?: string;
  /** Name of the live run's data set, for a filter that only that run has. */
  live?: string;
}

export interface DataSet {
  name: string;
  /** Index of the episode that is displayed first. */
  first: number;
  episodes: EpisodeSummary[];
  live?: LiveRun;
}

export interface Task {
  name: string;
  components: Component[];
  modalities: string[];
  /** Duration of a step in s. */
  dt: number;
  map: { x: string; y: string; half_width: number };
  filters: Filter[];
  data: DataSet[];
  fault_presets: { name: string; faults: string }[];
}

export interface FaultParameter {
  name: string;
  default: number | string | null;
  unit: string;
  meaning: string;
}

export interface Fault {
  fault: string;
  meaning: string;
  parameters: FaultParameter[];
}

export interface Catalog {
  version: string;
  read_only: boolean;
  tasks: Task[];
  faults: Fault[];
  problems: string[];
}

/** Names of a run: a filter, an episode and a fault injection. */
export interface Selection {
  task: string;
  filter: string;
  data: string;
  episode: number;
  faults: string;
  /** Differences of the comparison run; empty for the run itself. */
  against?: string;
}

export interface ColumnHeader {
  name: string;
  /** Steps first. */
  shape: number[];
  /** Bytes from the start of the columns. */
  offset: number;
}

export interface TraceHeader {
  steps: number;
  dt: number;
  kind: string;
  filter: string;
  episode: number;
  components: Component[];
  modalities: string[];
  weight_width: number;
  settings: { particles?: number; edits?: { from: number; to: number }[] };
  /** 95 % interval of the NEES of a consistent filter. */
  nees_bounds: [number, number] | null;
  /** Why there are no likelihood maps. */
  no_maps: string | null;
  /** Height and width of the camera images. */
  pictures: [number, number] | null;
  columns: ColumnHeader[];
  /** Layers of the 3D scene. */
  scene: string[];
  live?: LiveRun;
}

export interface LiveRun {
  name: string;
  data: string;
  task: string;
  filter: string;
  /** Whether the server has the checkpoint. */
  here: boolean;
  kind: string;
  episode: number;
  faults: string;
  steps: number;
  expected: number | null;
  started: number;
  state: string;
  /** Message about the state. */
  told: string;
}

export interface Job {
  id: string;
  kind: string;
  title: string;
  state: string;
  progress: number;
  message: string;
  error: string;
  link: string;
  asked: number;
  started: number | null;
  ended: number | null;
}

export interface Recording {
  name: string;
  url: string;
  bytes: number;
  /** Time that it took; null for a recording that existed before. */
  seconds: number | null;
  job?: undefined;
}

export interface DiagnosticEntry {
  name: string;
  title: string;
  question: string;
  slow: boolean;
  why_not: string | null;
  options: { name: string; meaning: string; default: string }[];
}

export interface DiagnosticTable {
  title: string;
  columns: string[];
  rows: (string | number | null)[][];
}

export interface DiagnosticCurve {
  name: string;
  values: (number | null)[];
  chart: string;
  unit: string;
  layer: string;
  bounds: [number, number] | null;
}

export interface DiagnosticPlot {
  title: string;
  x_label: string;
  y_label: string;
  kind: 'line' | 'points' | 'bars';
  diagonal: boolean;
  lines: { name: string; x: number[]; y: (number | null)[]; layer: string }[];
}

export interface DiagnosticImage {
  title: string;
  values: number[][];
  unit: string;
  signed: boolean;
}

export interface DiagnosticResult {
  verdict: string;
  trajectories: number;
  tables: DiagnosticTable[];
  curves: DiagnosticCurve[];
  bands: Record<string, boolean[]>;
  plots: DiagnosticPlot[];
  pictures: DiagnosticImage[];
  /** Names of both runs, in a comparison. */
  names?: [string, string];
  job?: undefined;
}

/** The job that computes a result; null if it was not started. */
export interface PendingResult {
  job: Job | null;
}

export interface StartedJob {
  job: Job;
}

export interface FailureEvent {
  episode: number;
  step: number;
  first: number;
  last: number;
  value: number;
  group: string;
  also: string[];
  error: (number | null)[];
  nees: number | null;
  ess: number | null;
  effective_weights: number[] | null;
  link: string;
}

export interface FailureGroup {
  name: string;
  steps: number;
  events: number;
  share: number;
  failures: number;
  lift: number;
  chance: number;
  inside: number;
  outside: number;
  telling: boolean;
}

export interface FailureScore {
  name: string;
  title: string;
  unit: string;
  why_not: string | null;
  verdict?: string;
  threshold?: number;
  total?: number;
  counts?: Record<string, number>;
  groups?: FailureGroup[];
  events?: FailureEvent[];
}

export interface FailureEpisode {
  index: number;
  steps: number;
  rmse: number;
  worst: number;
  worst_step: number;
  error: number[];
  contact: boolean[];
}

/** Failures of a filter over a data set. */
export interface Failures {
  layers: string[];
  particles: number | null;
  steps: number;
  scores: FailureScore[];
  episodes: FailureEpisode[];
  job?: undefined;
}
