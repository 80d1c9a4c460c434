"""Trials: scheduler, contestant, referee, recording, reports, command line."""
