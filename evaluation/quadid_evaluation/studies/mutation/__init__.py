"""Mutation testing of gate, ledger and session: does a test go red when a line is spoilt, and if not, is that bad?"""
