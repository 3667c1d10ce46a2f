"""The next default method: all details before any height (step 26)."""
