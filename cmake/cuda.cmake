# SPDX-License-Identifier: Apache-2.0
# The CUDA library: kernels free of torch headers, and the same *_op.cpp files compiled a second time
# against the CUDA backend.
if(BLITZGS_CUDA_ARCHS STREQUAL "all")
  # This library runs on other machines. GPUs newer than the last architecture compile its PTX when they load it.
  set(
    CMAKE_CUDA_ARCHITECTURES
    80-real
    86-real
    89-real
    90-real
    100-real
    120
  )
  # A third of the size. The driver decompresses a kernel when it is first used.
  set(compress --compress-mode=size)
elseif(BLITZGS_CUDA_ARCHS)
  set(CMAKE_CUDA_ARCHITECTURES ${BLITZGS_CUDA_ARCHS})
else()
  execute_process(COMMAND nvidia-smi -L RESULT_VARIABLE no_gpu OUTPUT_QUIET ERROR_QUIET)
  if(no_gpu)
    set(CMAKE_CUDA_ARCHITECTURES 90)
  else()
    set(CMAKE_CUDA_ARCHITECTURES native)
  endif()
endif()
message(STATUS "blitzgs: CUDA architectures ${CMAKE_CUDA_ARCHITECTURES}")
enable_language(CUDA)
find_package(CUDAToolkit REQUIRED)
set(CMAKE_CUDA_STANDARD 20)
set(CMAKE_CUDA_RUNTIME_LIBRARY Static)

list(JOIN CMAKE_CUDA_ARCHITECTURES "," architectures)
set_source_files_properties(
  csrc/common/build_cuda.cu
  PROPERTIES COMPILE_DEFINITIONS "BLITZGS_CUDA_BUILD=\"${CMAKE_CUDA_COMPILER_VERSION} ${architectures}\""
)
add_library(blitzgs_cuda SHARED ${schema_digest_source} ${op_sources} ${cuda_kernels})
target_compile_definitions(blitzgs_cuda PRIVATE BLITZGS_BACKEND_CUDA USE_CUDA)
if(BLITZGS_SM80_BRANCHES)
  target_compile_definitions(blitzgs_cuda PRIVATE BLITZGS_SM80_BRANCHES=1)
endif()
if(BLITZGS_SMALL_STATES)
  target_compile_definitions(blitzgs_cuda PRIVATE BLITZGS_SMALL_STATES=${BLITZGS_SMALL_STATES})
endif()
target_link_libraries(blitzgs_cuda PRIVATE blitzgs_flags blitzgs_torch CUDA::cudart_static)
target_compile_options(
  blitzgs_cuda
  PRIVATE
    $<$<COMPILE_LANGUAGE:CUDA>:--expt-relaxed-constexpr
    --extended-lambda
    -Xcompiler=-Wall
    -lineinfo
    ${compress}
    -diag-suppress=20012>
)

# Several kernels compute the same splats, colours and tiles. Without contraction they all get the same bits.
set_source_files_properties(
  ${CMAKE_SOURCE_DIR}/csrc/project/project_cuda.cu
  ${CMAKE_SOURCE_DIR}/csrc/project/write_splats_cuda.cu
  ${CMAKE_SOURCE_DIR}/csrc/intersect/intersect_cuda.cu
  PROPERTIES COMPILE_OPTIONS "-fmad=false"
)

if(BLITZGS_EXACT_EXP)
  file(GLOB rasterize_kernels csrc/rasterize/*_cuda.cu csrc/importance/*_cuda.cu)
  set_source_files_properties(${rasterize_kernels} PROPERTIES COMPILE_DEFINITIONS BLITZGS_EXACT_EXP)
endif()

# The library needs libtorch_cuda.so when it is loaded. A CPU-only torch has none to link against, so
# a stub of the same soname stands in; the real one is found when the library is loaded.
file(
  WRITE ${CMAKE_BINARY_DIR}/torch_cuda_stub.cpp
  "extern \"C\" __attribute__((visibility(\"default\"))) int blitzgs_torch_cuda_stub() { return 0; }\n"
)
add_library(torch_cuda_stub SHARED ${CMAKE_BINARY_DIR}/torch_cuda_stub.cpp)
set_target_properties(
  torch_cuda_stub
  PROPERTIES OUTPUT_NAME torch_cuda LIBRARY_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/stub
)
target_link_options(blitzgs_cuda PRIVATE -Wl,--no-as-needed -Wl,--allow-shlib-undefined)
target_link_libraries(blitzgs_cuda PRIVATE torch_cuda_stub)
