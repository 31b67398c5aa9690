# SPDX-License-Identifier: Apache-2.0
# pycolmap brings a libpng and a zlib of its own that cv2 would call if pycolmap were imported first.
import cv2  # noqa: F401
