/** How often the 3D scene may follow a drag. It is drawn in the page's own thread, for long where there is no GPU. */

const SLOW = 50; // ms; a longer frame is one in which something heavy was drawn
const WATCHED = 1500; // ms after the last request during which frames are watched
/** The scene waits so many times as long as it takes to draw: a hand must not feel it, a replay may. */
export const SHARE = { hand: 30, clock: 3 };
const MOST = 600; // ms of drawing that are believed: the first picture takes longer than any after it

export class Pace {
  #turn = -Infinity; // when the scene was drawn last
  #cost = 0; // ms of slow frames since then
  #before = 0; // and in the turn before
  #until = 0;
  #watching = false;

  /** Whether it is the scene's turn: always where it costs nothing. @param {number} share one of SHARE */
  mayDraw(share) {
    this.#until = performance.now() + WATCHED;
    if (!this.#watching) this.#watch();
    return performance.now() >= this.#turn + share * Math.min(MOST, Math.max(this.#cost, this.#before));
  }

  /** The scene is being drawn. */
  taken() {
    [this.#before, this.#cost, this.#turn] = [this.#cost, 0, performance.now()];
  }

  #watch(last = Infinity) {
    this.#watching = true;
    requestAnimationFrame((now) => {
      if (now - last > SLOW) this.#cost += now - last;
      this.#watching = now < this.#until;
      if (this.#watching) this.#watch(now);
    });
  }
}
