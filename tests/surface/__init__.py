"""What programs and people see of zscout, as it was before the rebuild, compared with today's."""
