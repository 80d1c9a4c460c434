"""A Crazyradio in software: cflib's own ``radio://`` driver flies simulated vehicles over it.

From the antenna up: ``air_time`` (durations), ``receiver`` (a vehicle's radio chip), ``air``
(who hears whom), ``link`` (a vehicle's end, for the server), ``gateway`` and ``remote`` (the air
of another process), ``dongle`` (the device), ``usb_backend`` (what pyusb finds).
"""
