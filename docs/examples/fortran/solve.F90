! Solves what `petsc-fs convert` wrote: a MatNest with named blocks, vectors composed on them, and an options file.
program solve
#include <petsc/finclude/petscksp.h>
  use petscksp
  implicit none

  character(len=10), parameter :: names(5) = [character(len=10) :: 'contact', 'intf_force', 'momentum', 'intf_flow', 'mass']
  character(len=18), parameter :: composed(2) = [character(len=18) :: 'fixed_stress_base', 'fixed_stress_ratio']
  character(len=256) :: folder, text
  Mat            :: A, J, block(25)
  Vec            :: b, x, r, part
  IS             :: rows(5), loaded, all
  VecScatter     :: scatter
  KSP            :: ksp
  PetscViewer    :: viewer
  PetscLogDouble :: info(MAT_INFO_SIZE)
  PetscInt       :: i, k, n, first, cells, its, dim, bs(5)
  PetscInt, pointer :: numbers(:)
  PetscMPIInt    :: rank, ranks
  PetscReal      :: residual, norm
  PetscBool      :: set
  PetscErrorCode :: ierr

  PetscCallA(PetscInitialize(ierr)) ! -options_file FILE -python
  folder = 'model1_petsc'
  dim = 2
  PetscCallA(PetscOptionsGetString(PETSC_NULL_OPTIONS, PETSC_NULL_CHARACTER, '-dir', folder, set, ierr))
  PetscCallA(PetscOptionsGetInt(PETSC_NULL_OPTIONS, PETSC_NULL_CHARACTER, '-dim', dim, set, ierr))
  bs = [dim, dim, dim, 1, 1]

  call open('matrix.petsc')
  PetscCallA(MatCreate(PETSC_COMM_WORLD, A, ierr))
  PetscCallA(MatLoad(A, viewer, ierr))
  PetscCallA(PetscViewerDestroy(viewer, ierr))
  PetscCallA(MatCreateVecs(A, PETSC_NULL_VEC, b, ierr))
  call open('rhs.petsc')
  PetscCallA(VecLoad(b, viewer, ierr))
  PetscCallA(PetscViewerDestroy(viewer, ierr))

  ! Rows of each field, as many whole cells on each rank as on the next.
  PetscCallMPIA(MPI_Comm_rank(PETSC_COMM_WORLD, rank, ierr))
  PetscCallMPIA(MPI_Comm_size(PETSC_COMM_WORLD, ranks, ierr))
  do i = 1, 5
    call open('fields/'//trim(names(i))//'.petsc')
    PetscCallA(ISCreate(PETSC_COMM_WORLD, loaded, ierr))
    PetscCallA(ISLoad(loaded, viewer, ierr))
    PetscCallA(PetscViewerDestroy(viewer, ierr))
    PetscCallA(ISAllGather(loaded, all, ierr))
    PetscCallA(ISGetIndicesF90(all, numbers, ierr))
    cells = size(numbers) / bs(i)
    first = bs(i) * (rank * (cells / ranks) + min(rank, mod(cells, ranks)))
    n = bs(i) * (cells / ranks + merge(1, 0, rank < mod(cells, ranks)))
    PetscCallA(ISCreateGeneral(PETSC_COMM_WORLD, n, numbers(first + 1:first + n), PETSC_COPY_VALUES, rows(i), ierr))
    PetscCallA(ISSetBlockSize(rows(i), bs(i), ierr))
    PetscCallA(ISRestoreIndicesF90(all, numbers, ierr))
    PetscCallA(ISDestroy(all, ierr))
    PetscCallA(ISDestroy(loaded, ierr))
  end do

  ! A block per pair of fields, null where it has no entry. Those on the diagonal carry the names.
  do i = 1, 5
    do k = 1, 5
      associate (B_ik => block(5 * (i - 1) + k))
        PetscCallA(MatCreateSubMatrix(A, rows(i), rows(k), MAT_INITIAL_MATRIX, B_ik, ierr))
        PetscCallA(MatSetBlockSizes(B_ik, bs(i), bs(k), ierr))
        PetscCallA(MatGetInfo(B_ik, MAT_GLOBAL_SUM, info, ierr))
        if (i == k) then
          PetscCallA(PetscObjectSetName(B_ik, trim(names(i)), ierr))
        else if (info(MAT_INFO_NZ_USED) == 0) then
          PetscCallA(MatDestroy(B_ik, ierr))
          B_ik = PETSC_NULL_MAT
        end if
      end associate
    end do
  end do
  do i = 1, 2 ! What the fixed-stress approximation needs, on the block of pressure.
    call open('fields/mass.'//trim(composed(i))//'.petsc')
    PetscCallA(MatCreateVecs(block(25), PETSC_NULL_VEC, part, ierr))
    PetscCallA(VecLoad(part, viewer, ierr))
    PetscCallA(PetscViewerDestroy(viewer, ierr))
    PetscCallA(PetscObjectCompose(block(25), trim(composed(i)), part, ierr))
    PetscCallA(VecDestroy(part, ierr))
  end do
  i = 5
  PetscCallA(MatCreateNest(PETSC_COMM_WORLD, i, PETSC_NULL_IS, i, PETSC_NULL_IS, block, J, ierr))

  ! A vector of the nest has, on each rank, one field after the other.
  PetscCallA(MatCreateVecs(J, x, r, ierr))
  PetscCallA(ISConcatenate(PETSC_COMM_WORLD, i, rows, all, ierr))
  PetscCallA(VecScatterCreate(b, all, r, PETSC_NULL_IS, scatter, ierr))
  PetscCallA(VecScatterBegin(scatter, b, r, INSERT_VALUES, SCATTER_FORWARD, ierr))
  PetscCallA(VecScatterEnd(scatter, b, r, INSERT_VALUES, SCATTER_FORWARD, ierr))

  PetscCallA(KSPCreate(PETSC_COMM_WORLD, ksp, ierr))
  PetscCallA(KSPSetOperators(ksp, J, J, ierr))
  PetscCallA(KSPSetFromOptions(ksp, ierr))
  PetscCallA(KSPSolve(ksp, r, x, ierr))

  PetscCallA(VecNorm(r, NORM_2, norm, ierr))
  PetscCallA(VecScale(x, -1.0d0, ierr))
  PetscCallA(MatMultAdd(J, x, r, r, ierr))
  PetscCallA(VecNorm(r, NORM_2, residual, ierr))
  PetscCallA(KSPGetIterationNumber(ksp, its, ierr))
  write (text, '(i0, a, es7.1, a)') its, ' iterations, true relative residual ', residual / norm, new_line('a')
  PetscCallA(PetscPrintf(PETSC_COMM_WORLD, trim(text), ierr))
  PetscCallA(PetscFinalize(ierr))

contains

  subroutine open(file)
    character(len=*), intent(in) :: file
    PetscCallA(PetscViewerBinaryOpen(PETSC_COMM_WORLD, trim(folder)//'/'//file, FILE_MODE_READ, viewer, ierr))
  end subroutine open

end program solve
