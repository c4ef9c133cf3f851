"""The certificates and rights of a `Lab` on a secured fleet, for tests that know nothing of them."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from zscout.config.certificate_authority import CertificateAuthority

DAY = timedelta(days=1)
PERSON = "test"
"""Who runs tests: as the person's programs and commands say, and in certificates."""
OTHERS = ("bob", "elsewhere", "killed")
"""More persons."""
EYE = "eye"
"""A manager that leads never: it looks at RCs."""
HOSTS = (
    *(
        "a",
        "anvil",
        "b",
        "bellows",
        "bench",
        "boss",
        "c",
        "calm",
        "cart",
        "clamp",
        "d",
        "desk",
        "devices",
        EYE,
        "h0",
        "h1",
    ),
    *("h2", "h3", "heir", "here", "lead", "leader", "mast", "n", "r", "rcs", "small", "there", "v", "ws1", "ws2"),
)


class Present:
    """What `tests/fleets.py` runs at present."""

    secured = False


class Certificates:
    """A CA, and a certificate for each name from its first use on."""

    def __init__(self, folder: Path, managers: Iterable[str] = ()) -> None:
        self._folder = folder
        self._managers = frozenset(managers or HOSTS) | {EYE}
        CertificateAuthority.make(folder / "ca", DAY, datetime.now(UTC))
        self._authority = CertificateAuthority.read(folder / "ca", datetime.now(UTC))

    def of(self, name: str) -> Path:
        """The folder of this name."""
        keys = self._folder / name
        if not keys.exists():
            self._authority.issue(name, keys, DAY, datetime.now(UTC), manager=name in self._managers)
        return keys

    def secured(self, extra: str) -> str:
        """These tables of a fleet file, with `[security]`, roles, a group, access and quotas: persons are operators."""
        persons = (PERSON, *OTHERS)
        tables = {
            "[security]": f'folder = "{self.of(PERSON)}"\n',
            "[roles]": f"manager = [{_quoted(sorted(self._managers))}]\noperator = [{_quoted(persons)}]\n",
            "[roles.node]": "".join(f'{host} = ["*/*"]\n' for host in HOSTS),
            "[groups]": f"people = [{_quoted(persons)}]\n",
            "[access]": f'"*/*" = ["people", {_quoted(HOSTS)}]\n',
            "[quotas.people]": "rcs = 1000\narcs = 10000\n",
        }
        for title, lines in tables.items():
            before, found, after = extra.partition(f"{title}\n")
            extra = f"{before}{title}\n{lines}{after}" if found else f"{before}\n{title}\n{lines}"
        return extra


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)
