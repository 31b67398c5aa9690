# SPDX-License-Identifier: Apache-2.0
"""The viewer: a page in the browser that shows a model, or a training as it goes on."""
