"""The error reply: what a refused or failed query is answered with."""

from pydantic import Field

from ldcnd.errors import ErrorCode
from ldcnd.model.frozen import Frozen


class ReceivedError(Frozen):
    """Why a query was not carried out, as a client reads it: the daemon may be newer and know more codes."""

    code: str = Field(description="what went wrong")
    message: str = Field(description="one sentence for a person: what, to whom, which value, which limit")
    retryable: bool = Field(description="the same request may be sent again without harm and may then succeed")
    axis: str | None = Field(default=None, description="the axis concerned")
    value: float | str | None = Field(default=None, description="the offending value, in the unit that the caller used")
    limit: float | str | None = Field(default=None, description="the limit that the value broke")
    nearest: float | None = Field(default=None, description="the closest value that would be accepted")
    remedy: str | None = Field(default=None, description="what to do about it")
    page: str | None = Field(default=None, description="where its page is, below a console or the documentation")


class ErrorReply(ReceivedError):
    """Why a query was not carried out; sent as JSON in an error reply, whatever the query's encoding."""

    code: ErrorCode = Field(description="what went wrong, out of a closed list")
