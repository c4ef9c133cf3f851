"""`make model`: what TLC says of `ownership.tla`. Each guard of the protocol is taken out in turn as well, and must
break something."""

from __future__ import annotations

import sys

from formal.tlc import GUARDS, Instance, NoTlc, check, jar
from zscout import terminal

INSTANCES = (
    Instance("safety", terms=3, steps=2, joins=2),
    Instance("safety, longer reigns", terms=2, steps=3, joins=3),
    Instance("progress", terms=2, steps=2, joins=4, losses=False, fair=True),
)
WITHOUT = tuple(
    Instance(f"without {guard}", terms=2, steps=3, joins=3, guards=tuple(one for one in GUARDS if one != guard))
    for guard in GUARDS
)


def main(names: list[str]) -> int:
    try:
        jar()
    except NoTlc as error:
        terminal.print_line(f"skipped: {error}")
        return 0
    rows, failed = [], False
    for instance in (*WITHOUT, *INSTANCES):
        if names and instance.name not in names:
            continue
        terminal.print_line(f"{instance.name} ...")
        outcome = check(instance)
        expected = instance in WITHOUT
        failed |= (outcome.violated is not None) != expected
        said = f"breaks {outcome.violated}" if outcome.violated else "holds"
        bounds = f"{instance.terms} terms of {instance.steps} steps"
        rows.append([instance.name, bounds, f"{outcome.states:,}", f"{outcome.took:.0f} s", said])
        if (outcome.violated is not None) != expected:
            terminal.print_line(outcome.text)
    terminal.print_table(["instance", "bounds", "states", "took", "outcome"], rows)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
