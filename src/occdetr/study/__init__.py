"""Studies: several training runs that are compared, their records, tables and curves."""
