"""Bookings of all candidates: merged records, their dates, and fleet time."""
