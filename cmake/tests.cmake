# SPDX-License-Identifier: Apache-2.0
# Catch2 v2 (one header) and v3 (a library) both work; see csrc/common/catch.h.
find_package(Catch2 QUIET)
if(NOT Catch2_FOUND)
  find_path(CATCH2_INCLUDE catch2/catch.hpp REQUIRED)
endif()
file(GLOB test_sources CONFIGURE_DEPENDS csrc/*/*_test.cpp)
file(GLOB io_library CONFIGURE_DEPENDS csrc/io/*.cpp)
list(FILTER io_library EXCLUDE REGEX "_test\\.cpp$")
add_executable(
  blitzgs_tests
  csrc/common/catch_main.cpp
  csrc/common/parallel_std.cpp
  ${test_sources}
  ${cpu_kernels}
  ${avx2_kernels}
  ${io_library}
)
target_link_libraries(blitzgs_tests PRIVATE blitzgs_flags pthread)
if(Catch2_FOUND AND Catch2_VERSION VERSION_GREATER_EQUAL 3)
  target_link_libraries(blitzgs_tests PRIVATE Catch2::Catch2WithMain)
  target_compile_definitions(blitzgs_tests PRIVATE BLITZGS_CATCH2_V3)
elseif(Catch2_FOUND)
  target_link_libraries(blitzgs_tests PRIVATE Catch2::Catch2)
else()
  target_include_directories(blitzgs_tests SYSTEM PRIVATE ${CATCH2_INCLUDE})
endif()
if(BLITZGS_SANITIZE)
  # Lines alone: with variables (-g), GCC takes several times as long for the kernels of compositing.
  target_compile_options(blitzgs_tests PRIVATE -fsanitize=address,undefined -fno-omit-frame-pointer -g1)
  target_link_options(blitzgs_tests PRIVATE -fsanitize=address,undefined)
endif()
add_test(NAME kernels COMMAND blitzgs_tests)
# Catch2's own code is neither hot nor under test; optimising it under the sanitizers takes a minute.
set_source_files_properties(csrc/common/catch_main.cpp PROPERTIES COMPILE_OPTIONS "-O0;-fno-sanitize=all")
