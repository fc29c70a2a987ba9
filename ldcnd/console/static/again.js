/** Of the page of a browser that is not let in: asks once more, as a page of this console.
 *
 * A browser keeps its cookies of this console (SameSite=Strict) from a request that another site has led to, a link there
 * included, and from every reload of what came of it. What this page asks for is the console's own. Nothing is carried out
 * by that, and the cookies stay as strict as they are: no other site can send them.
 */

const ASKED = "again";

if (!new URLSearchParams(location.search).has(ASKED)) location.replace(`${location.pathname}?${ASKED}${location.hash}`);
