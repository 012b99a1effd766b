"""What the stages do, as functions from a task and a store to an output.

No Ray and no coordinator here.
"""
