import { sentence } from '../core/units.js';

/** An error with a message for the user, in sentences. */
export class ServerError extends Error {
  /** @param {string} message */
  constructor(message) {
    super(sentence(message));
  }
}
