"""Vehicle, driver, electric machine and its 70-node thermal network: the truth of the closed loop."""
