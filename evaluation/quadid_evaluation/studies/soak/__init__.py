"""Long runs of the service: a day of flight at accelerated time, and an hour in real time over DDS."""
