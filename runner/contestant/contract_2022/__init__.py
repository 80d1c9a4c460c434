"""The contract of the 2022 competition: what a controller is told and may answer."""
