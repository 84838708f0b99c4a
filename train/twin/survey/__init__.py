"""The floor that recordings show: maps, scans and poses in them, as a floor of the twin."""
