"""Estimators run off line over a recorded drive: the C core under its settings, and the baselines it is compared with.

One file each, one interface (`drive.Estimator`): drives in, the estimate of the temperatures *now* at every 0.1 s out.
"""
