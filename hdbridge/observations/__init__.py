"""What a record says that was observed: readings, cuts, the driving angle and its turns.

Both estimations, `identify` and `diagnose`, take a record's samples from here, so that one record has one
count, one number of reversals and the same cuts for both.
"""
