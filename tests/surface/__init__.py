"""What programs and people see of zscout, held against what was recorded."""
