"""The messages of the mesh: JSON objects with their schema in the Zenoh encoding (`docs/protocol/messages.md`).

Durations are seconds, never wall times. Unknown fields are ignored, wrong types rejected. Terms, grants and places are
arrays that compare element by element: `[counter, rcm]`, `[term, seq]`, `[term, arrival]`."""

from __future__ import annotations

from zscout.messages.base import *
from zscout.messages.behaviors import *
from zscout.messages.bookings import *
from zscout.messages.components import *
from zscout.messages.controllers import *
from zscout.messages.history import *
from zscout.messages.hosts import *
from zscout.messages.scheduling import *
