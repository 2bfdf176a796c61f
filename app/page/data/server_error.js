/** An error with a message for the user. */
export class ServerError extends Error {}
