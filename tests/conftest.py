# SPDX-License-Identifier: Apache-2.0
import blitzgs  # noqa: F401  (before torch: it sets how OpenMP threads wait)
