"""A real fleet under real faults, each program in a network namespace of its own, held against docs/promises.md."""
