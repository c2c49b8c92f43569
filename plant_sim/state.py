"""Layout of the scalar state and of one recorded row; reference and compiled step share it."""

# Scalar state of vehicle and driver.
X, V, INTEGRAL, TORQUE, GRADE = range(5)
N_STATE = 5

# Columns of one recorded tick: what acted over the step that ends at the tick, and the state at the tick.
(ROW_TORQUE, ROW_SPEED, ROW_V, ROW_X, ROW_V_REF, ROW_SLOPE, ROW_THETA_W, ROW_THETA_R) = range(8)
N_ROW = 8
