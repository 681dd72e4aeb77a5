"""The board: whole commands on fixed footage, one row each, beside what they reached before."""
