"""The roster: who belongs to a site and in which role; a JSON file that people can read."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from ldcnd.errors import ConfigError
from ldcnd.model.frozen import Frozen
from ldcnd.pki.access import Role

FILE = "roster.json"
RESERVED = frozenset({"ca", "roster"})
"""Names of the files beside those of the logins."""

LoginName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_.-]{0,62}$")]


class Login(Frozen):
    """One login of a site."""

    name: LoginName
    """The common name of its certificate, and of its files."""
    role: Role
    """What it may do."""
    hosts: tuple[str, ...] = ()
    """Where a daemon or a router can be found: host names and IP addresses."""
    revoked: bool = False
    """It may do nothing any more. It stays on the roster, because its certificate lives on: a second login of this name
    would give the old certificate its rights back."""


class Roster(Frozen):
    """All logins that a site ever had."""

    logins: tuple[Login, ...] = ()

    def names(self, role: Role) -> tuple[str, ...]:
        """Return who has a role now."""
        return tuple(login.name for login in self.logins if login.role is role and not login.revoked)

    def find(self, name: str) -> Login | None:
        """Return the login of that name, revoked or not."""
        return next((login for login in self.logins if login.name == name), None)

    def with_login(self, login: Login) -> "Roster":
        """Return the roster with one more login, or with that login changed."""
        others = tuple(other for other in self.logins if other.name != login.name)
        return Roster(logins=(*others, login))


def read_roster(folder: Path) -> Roster:
    """Return the roster of a site.

    Raises:
        ConfigError: the folder has none, or it cannot be understood.
    """
    file = folder / FILE
    try:
        return Roster.model_validate_json(file.read_bytes())
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}; `ldcnd pki init {folder}` makes one") from error
    except ValidationError as error:
        raise ConfigError(f"{file}: is no roster: {error.errors()[0]['msg']}") from error
