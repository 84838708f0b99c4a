"""The kinds of missions that the twin stages and scores, a file each."""
