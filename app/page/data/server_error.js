import { sentence } from '../core/units.js';

/** An error with a message for the user, in sentences. */
export class ServerError extends Error {
  /**
   * @param {string} message
   * @param {number} [status] of the response; 0 if there is none
   */
  constructor(message, status = 0) {
    super(sentence(message));
    this.status = status;
  }

  /** Whether the server cannot accept the request: the same request fails again. */
  get isRefusal() {
    return this.status === 400;
  }
}
