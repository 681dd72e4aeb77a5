"""The board: whole commands on fixed footage, one row each, compared with an earlier record."""
