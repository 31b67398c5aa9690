# SPDX-License-Identifier: Apache-2.0
# pycolmap has its own libpng and zlib; cv2 would call these if pycolmap were imported first.
import cv2  # noqa: F401
