/** Search in the titles of commands. */

/**
 * Rates how well a text matches a query: each word of the query must occur, better at the start of a word; null if not.
 * @param {string} query
 * @param {string} text
 */
export function rating(query, text) {
  const target = text.toLowerCase();
  let sum = 0;
  for (const word of query.toLowerCase().split(/\s+/).filter(Boolean)) {
    const places = positions(word, target);
    if (!places.length) return null;
    sum += Math.max(...places.map((place) => value(target, place)));
  }
  return sum;
}

/**
 * Returns the items that match a query, the best first and otherwise in their order.
 * @template T
 * @param {string} query
 * @param {readonly T[]} items
 * @param {(item: T) => string} textOf
 * @returns {T[]}
 */
export function search(query, items, textOf) {
  return items
    .flatMap((item) => {
      const score = rating(query, textOf(item));
      return score === null ? [] : [{ item, score }];
    })
    .sort((a, b) => b.score - a.score)
    .map(({ item }) => item);
}

/**
 * @param {string} word
 * @param {string} text
 */
function positions(word, text) {
  /** @type {number[]} */
  const places = [];
  for (let place = text.indexOf(word); place >= 0; place = text.indexOf(word, place + 1))
    places.push(place);
  return places;
}

/**
 * @param {string} text
 * @param {number} place
 */
const value = (text, place) => (place === 0 ? 3 : /[^a-z\d]/.test(text[place - 1]) ? 2 : 1);
