# SPDX-License-Identifier: Apache-2.0
"""The ops of BlitzGS: one file per op with its public function, fake kernel and autograd formula."""
