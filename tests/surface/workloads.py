"""500 random workload files, one for each seed: all that a request can say, in several patterns of arrival.

They are small, so that no search of `optimal` or `adaptive` runs out of steps in ways that depend on what is
installed, and 1500 replays take a minute or two.
"""

from __future__ import annotations

from random import Random
from typing import Final

SEEDS: Final = 500
KINDS: Final = ("robot", "framegrabber", "camera")
RUNTIMES: Final = ("1", "2", "3", "5")
LONG_RUNTIMES: Final = ("20", "45", "60", "90.5")
"""With these some wait for longer than the patience of `adaptive`."""
SHARES: Final = ("0.1", "0.2", "0.3", "0.5", "1")
"""0.1 and 0.2 fill 0.3 exactly, which floats would not."""
CAPACITIES: Final = ("0.3", "0.6", "1", "2.5")
PRIORITIES: Final = ((1,), (1, 2, 3), (0, 1, 2, 3, 4, 5), (1, 1, 1, 2, 10))
ABSENT: Final = "robot/absent"


def workload(seed: int) -> str:
    """The text of the workload file of a seed: the same on every machine."""
    # Strings seed by their text, not by their hash, which changes from process to process.
    random = Random(f"surface/{seed}")  # noqa: S311 - workloads, not secrets
    exclusive = [f"{random.choice(KINDS)}/{number}" for number in range(random.choice((1, 2, 3, 4, 6, 8, 12)))]
    radios = [f"radio/rf{number}" for number in range(random.choice((0, 0, 1, 1, 2, 3)))]
    lines = [f'[[rc]]\nname = "{name}"\n' for name in exclusive]
    for name in radios:
        bounds = {"rate": random.choice(CAPACITIES)}
        if random.random() < 0.3:
            bounds["width"] = random.choice(CAPACITIES)
        lines.append(f'[[rc]]\nname = "{name}"\nsharable = true\n')
        if random.random() < 0.85:
            lines.append(f"capacity = {_table(bounds)}\n")
    count = random.choice((2, 4, 6, 8, 10, 12, 16, 20, 28, 40))
    runtimes = random.choice((RUNTIMES, RUNTIMES, LONG_RUNTIMES, None))
    priorities = random.choice(PRIORITIES)
    patterns = random.choice((0.0, 0.0, 0.2, 0.6))
    for number, at in enumerate(_arrivals(random, count)):
        runtime = random.choice(runtimes) if runtimes else f"{random.randint(1, 9_000) / 1000:.3f}"
        lines.append(
            f'[[arc]]\nname = "a{number}"\nat = {at}\npriority = {random.choice(priorities)}\n'
            f"min_runtime = {runtime}\n[arc.needs]\n"
        )
        lines += _needs(random, exclusive, radios, patterns)
    return "".join(lines)


def _arrivals(random: Random, count: int) -> list[str]:
    """When they ask, in seconds: together, one after the other, in bursts, or at any millisecond."""
    match random.choice(("together", "steady", "bursts", "any")):
        case "together":
            return ["0"] * count
        case "steady":
            step = random.choice((0.25, 0.5, 1, 2))
            return [f"{number * step:g}" for number in range(count)]
        case "bursts":
            size, gap = random.choice((2, 4, 8)), random.choice((1, 3, 7))
            return [str(number // size * gap) for number in range(count)]
        case _:
            length = count * random.choice((300, 900, 2_500))
            return [f"{at / 1000:.3f}" for at in sorted(random.randrange(length) for _ in range(count))]


def _needs(random: Random, exclusive: list[str], radios: list[str], patterns: float) -> list[str]:
    """One to five RCs or patterns; radios with their shares, and now and then an RC that is not there."""
    width = min(len(exclusive), random.choice((1, 1, 2, 2, 3, 4, 5)))
    needs: dict[str, str] = {}
    for rc in random.sample(exclusive, width):
        if random.random() < patterns:
            kind = rc.partition("/")[0]
            pattern = random.choice((f"{kind}/*", f"{kind}/*", f"{kind}/$*{rc[-1]}", "*/*"))
            number = 1
            while (name := pattern if number == 1 else f"{pattern}#{number}") in needs:
                number += 1
            needs[name] = "{}"
        else:
            needs[rc] = "{}"
    # A pattern for any kind may not stand beside parameters.
    if radios and not any(need.startswith("*") for need in needs) and random.random() < 0.7:
        for radio in random.sample(radios, random.randint(1, len(radios))):
            share = {"rate": random.choice(SHARES)}
            if random.random() < 0.2:
                share["width"] = random.choice(SHARES)
            needs[radio] = _table(share)
    if random.random() < 0.02:
        needs[ABSENT] = "{}"
    return [f'"{need}" = {amounts}\n' for need, amounts in needs.items()]


def _table(values: dict[str, str]) -> str:
    return "{ " + ", ".join(f"{name} = {value}" for name, value in values.items()) + " }"
