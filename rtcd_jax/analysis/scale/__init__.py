"""Scaling studies: what a generation costs against the population and the devices, measured point by point."""
