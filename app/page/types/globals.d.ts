import type { FrameThrottle } from '../scene/scene_frame.js';
import type { Page } from '../core/page.js';
import type { Rerun } from '../tabs/rerun.js';
import type { State } from '../core/state.js';

declare global {
  interface Window {
    /** Access for the browser tests and the benchmarks. */
    beliefscope: {
      state(): State;
      stats: typeof import('../core/measurements.js').stats;
      timeline: Page['timeline'];
      live: Page['live'];
      rerun: {
        getState(): Promise<unknown>;
        files(files: Parameters<Rerun['files']>[0]): Promise<void>;
      };
    };
    /** In the frame of the 3D scene. */
    frameThrottle?: FrameThrottle;
  }
}
