"""Bookings, as all candidates keep them: records that are merged one by one, their dates, and fleet time."""
