/**
 * The part of Rerun's web viewer that the page uses. The server takes the module from the installed
 * rerun-notebook package.
 */
export interface ViewerState {
  active_store_id: string;
  recordings: {
    store_id: string;
    current_time?: { timeline: string; time: number | bigint };
  }[];
}

export class WebViewer {
  start(
    url: string | null,
    parent: HTMLElement,
    options: Record<string, string | boolean>,
  ): Promise<void>;
  open(urls: string[]): Promise<{ store_ids: string[] }>;
  close(recordings: { store_ids: string[] }): Promise<void>;
  get_state(): Promise<ViewerState>;
  set_time(time: { timeline: string; sequence: number; play_state: string }): Promise<void>;
  override_panel_state(panel: string, state: 'expanded' | undefined): void;
  on(event: 'time_update', listener: (event: { time: number }) => void): void;
}
