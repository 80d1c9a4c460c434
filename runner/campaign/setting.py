"""What every flight of the fault campaign has in common."""

VEHICLE = 1
BODY = "cf1"
OTHER = "cf9"  # stands about; somebody to be mixed up with

RATE = 30.0  # control steps per second
BOOT = 1.0  # s on the ground, for the estimators; in virtual time only
CLIMB = 1.6  # s; the slower controller takes twice as long
ONSET = (3.6, 5.6)  # s, when the fault sets in; BOOT included
MISSION = 8.0  # s, then the contestant lands
LAND_TIME = 2.5  # s
PATIENCE = 12.0  # s after the mission: nothing may take longer to end
