"""What a study will cost and did cost, from one table of prices."""
