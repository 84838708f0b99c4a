"""Diagnosis before training: are the rows that a critic will be fed what the twin says they are?"""
