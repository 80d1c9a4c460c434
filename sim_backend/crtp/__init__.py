"""The virtual Crazyflie: the vehicle's side of the CRTP protocol."""
