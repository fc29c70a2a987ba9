"""Former names, until the last importer has moved."""

from dataclasses import dataclass

from ldcnd.model import catalogue
from ldcnd.model.frozen import Frozen


@dataclass(frozen=True, slots=True)
class VerbModels:
    """What a verb takes and what it answers."""

    request: type[Frozen]
    reply: type[Frozen]


WHY, PLAN = "why", "plan"
ACQUIRE, RENEW, RELEASE, HOLDERS, OUTCOME, EVENTS = "acquire", "renew", "release", "holders", "outcome", "events"
REHEARSE, MOVE_TOGETHER, WIRE_LOG = "rehearse", "move_together", "wire_log"
AXIS_QUESTIONS = {verb: VerbModels(c, c.reply_model()) for verb, c in catalogue.AXIS_QUESTIONS.items()}
RIG_VERBS = {verb: VerbModels(c, c.reply_model()) for verb, c in catalogue.RIG_COMMANDS.items()}
