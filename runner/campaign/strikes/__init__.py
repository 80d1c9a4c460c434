"""How the faults of the campaign set in: functions that change a flight, by what they befall."""
